"""KITTI's camera and its calibration files."""

import re

import numpy as np
import pytest

from occdetr.errors import InputError
from occdetr.geometry.kitti import (
    KITTI_IMAGE_SIZE,
    kitti_camera,
    read_camera,
    write_calibration,
)
from scene_factory import CAMERA, one_line_error, project_brute_force


def test_written_calibration_reads_back_exactly(tmp_path):
    path = tmp_path / "calib.txt"
    write_calibration(path, CAMERA)
    read = read_camera(path, (370, 1226))
    np.testing.assert_array_equal(read.projection, CAMERA.projection)
    np.testing.assert_array_equal(read.lidar_to_camera, CAMERA.lidar_to_camera)
    assert read.image_size == (370, 1226)


def test_p2_and_tr_of_a_file_with_other_lines(tmp_path):
    path = tmp_path / "calib.txt"
    rows = {
        name: np.arange(12) + 12 * i + 1 for i, name in enumerate(["P0", "P1", "P2", "P3", "Tr"])
    }
    lines = [f"{name}: {' '.join(f'{v:e}' for v in row)}" for name, row in rows.items()]
    path.write_text("calib_time: 09-Jan-2012 13:57:47\r\n" + "\r\n".join(lines) + "\r\n\r\n")
    read = read_camera(path, (370, 1226))
    np.testing.assert_array_equal(read.projection.ravel(), rows["P2"])
    np.testing.assert_array_equal(read.lidar_to_camera[:3].ravel(), rows["Tr"])
    np.testing.assert_array_equal(read.lidar_to_camera[3], [0, 0, 0, 1])


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda text: re.sub(r"Tr:.*\n", "", text), ["'Tr:' is missing"]),
        (lambda text: text.replace("P2", "P3"), ["'P2:' is missing"]),
        (lambda text: text.replace("Tr: ", "Tr: 1.0 "), ["'Tr:'", "12 numbers"]),
        (lambda text: text.replace("P2: ", "P2: x"), ["'P2:'", "12 numbers"]),
        (lambda text: text.replace("P2: ", "P2: -"), ["'P2:'", "focal"]),
        (lambda text: "", ["'P2:' is missing"]),
    ],
)
def test_errors_name_file_and_line(tmp_path, change, parts):
    path = tmp_path / "calib.txt"
    write_calibration(path, CAMERA)
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError) as caught:
        read_camera(path, (370, 1226))
    assert one_line_error(caught, path, *parts)


def test_missing_and_binary_files_are_reported(tmp_path):
    with pytest.raises(InputError) as caught:
        read_camera(tmp_path / "calib.txt", (370, 1226))
    assert one_line_error(caught, tmp_path / "calib.txt", "missing")
    (tmp_path / "calib.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError) as caught:
        read_camera(tmp_path / "calib.txt", (370, 1226))
    assert one_line_error(caught, tmp_path / "calib.txt", "cannot be read")


def test_kittis_camera_scales_with_the_image():
    """A point is projected to the same normalised image coordinates at every image size."""
    point = np.array([[20.0, 3.0, -1.0]])
    full, _ = project_brute_force(point, kitti_camera())
    half, _ = project_brute_force(point, kitti_camera((185, 613)))
    np.testing.assert_allclose((half + 0.5) * 2, full + 0.5)
    assert kitti_camera().image_size == KITTI_IMAGE_SIZE
    assert kitti_camera((185, 613)).image_size == (185, 613)


@pytest.mark.parametrize("fov", [40.0, 90.0, 120.0])
def test_field_of_view_is_that_between_the_outer_pixel_edges(fov):
    camera = kitti_camera((100, 300), horizontal_fov=fov)
    focal, center = camera.projection[0, 0], camera.projection[0, 2]
    left, right = np.degrees(np.arctan((np.array([-0.5, 299.5]) - center) / focal))
    assert right - left == pytest.approx(fov)
    assert left == pytest.approx(-right)
