"""KITTI's camera and its calibration files."""

import numpy as np
import pytest

from occdetr.errors import InputError
from occdetr.geometry.kitti import (
    KITTI_IMAGE_SIZE,
    kitti_camera,
    read_calibration,
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


P2 = "P2: 700 0 600 45 0 700 180 0.1 0 0 1 0.005"
TR = "Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27"


def calibration(folder, data):
    """A calibration read from a file that holds ``data``."""
    path = folder / "calib.txt"
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_calibration(path)


@pytest.mark.parametrize(
    "text",
    [
        f"{P2}\n{TR}\n",
        f"\ufeff{P2}\r\n{TR}\r\n\r\n",
        f"{P2}\r{TR}",
        f"P0: x\ncalib_time: 09-Jan-2012 13:57:47\nnotes\n\n{TR}\nP0: y\n{P2}",
        f"{P2}\n{TR}\n".replace(" ", "\t"),
        f"{P2}\n{TR}\n".replace(" ", "   ").replace(":", " :"),
        f"{P2}\n{TR}\n".replace("700", "7.00e+02").replace("180", "+180.").replace("0.1", ".1"),
    ],
)
def test_texts_that_mean_the_same(tmp_path, text):
    read = calibration(tmp_path, text)
    np.testing.assert_array_equal(
        read.projection, [[700, 0, 600, 45], [0, 700, 180, 0.1], [0, 0, 1, 0.005]]
    )
    np.testing.assert_array_equal(
        read.lidar_to_camera, [[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]
    )
    assert read.image_size is None


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        (P2, ["'Tr:' is missing"]),
        (f"P3{P2[2:]}\n{TR}", ["'P2:' is missing"]),
        (f"{P2[:2]}{P2[3:]}\n{TR}", ["'P2:' is missing"]),  # no colon
        (f"p2{P2[2:]}\n{TR}", ["'P2:' is missing"]),
        (f"{P2}\n{TR} 1", ["'Tr:'", "12 numbers", "found 13"]),
        (f"{P2}\n{TR[:-6]}", ["'Tr:'", "12 numbers", "found 11"]),
        (f"P2:\n700 0 600 45\n0 700 180 0.1\n0 0 1 0\n{TR}", ["'P2:'", "found 0"]),
        (f"{P2}\n{TR}\n{P2}", ["'P2:' is there twice"]),
        (f"{P2}\n{TR}\nsize: 9 9\nsize: 9 9", ["'size:' is there twice"]),
        (f"{P2}\n{TR}".replace("0.1", "0,1"), ["'P2:'", "'0,1'"]),
        (f"{P2}\n{TR}".replace("700", "nan"), ["'P2:'", "'nan'"]),
        (f"{P2}\n{TR}".replace("45", "-inf"), ["'P2:'", "'-inf'"]),
        (f"{P2}\n{TR}".replace("45", "1e999"), ["'P2:'", "'1e999'"]),
        (f"{P2}\n{TR}".replace("700", "7_00"), ["'P2:'", "'7_00'"]),
        (f"{P2}\n{TR}".replace("700", "\u0667"), ["'P2:'"]),
        (f"{P2}\n{TR}".replace("700", "0"), ["'P2:'", "focal"]),
        (f"{P2}\n{TR}".replace("700", "-700"), ["'P2:'", "focal"]),
        (f"{P2}\n{TR}".replace("0 0 1 0.005", "0 0 0 0.005"), ["'P2:'", "form"]),
        (f"{P2}\n{TR}".replace("0 0 1 0.005", "0 0 2 0.005"), ["'P2:'", "form"]),
        (f"{P2}\nTr:{' 0' * 12}", ["'Tr:'", "no rotation"]),
        (f"{P2}\n{TR}".replace("0 -1 0 0 ", "0 -1.1 0 0 "), ["'Tr:'", "no rotation"]),
        (f"{P2}\n{TR}".replace("0 -1 0 0 ", "0 1 0 0 "), ["'Tr:'", "no rotation"]),  # mirrored
        (f"{P2}\n{TR}".replace("-0.27", "-270"), ["'Tr:'", "give metres"]),
        (f"{P2}\nTr: 0 0 1 0.27 -1 0 0 0 0 -1 0 -0.08", ["'Tr:'", "inverse"]),
        (f"{P2}\n{TR}\nsize: 1226", ["'size:'"]),
        (f"{P2}\n{TR}\nsize: 1226 0", ["'size:'"]),
        (f"{P2}\n{TR}\nsize: 1226x370", ["'size:'"]),
        ("", ["'P2:' is missing"]),
        (f"{P2}\n{TR}".encode("utf-16"), ["UTF-16"]),
        (f"{P2}\n{TR}".encode("utf-16-le"), ["not a text"]),
        (b"\x89PNG\r\n\x1a\n\x00\xff", ["not a text"]),
        (b"P2: 1\n" * 200_000, ["not a text"]),
    ],
)
def test_errors_name_file_and_line(tmp_path, data, parts):
    with pytest.raises(InputError) as caught:
        calibration(tmp_path, data)
    assert one_line_error(caught, tmp_path / "calib.txt", *parts)


def test_missing_files_and_folders_are_reported(tmp_path):
    for path, part in ((tmp_path / "calib.txt", "missing"), (tmp_path, "not a file")):
        with pytest.raises(InputError) as caught:
            read_camera(path, (370, 1226))
        assert one_line_error(caught, path, part)


def test_image_sizes_are_known_from_the_size_line_or_kittis_numbers(tmp_path):
    assert calibration(tmp_path, f"{P2}\n{TR}\nsize:\t1300 400").image_size == (400, 1300)
    odometry = {  # sequences 00, 03 and 04
        (376, 1241): "P2: 718.856 0 607.1928 45.38 0 718.856 185.2157 -0.11 0 0 1 0.0038",
        (375, 1242): "P2: 721.5377 0 609.5593 44.86 0 721.5377 172.854 0.2164 0 0 1 0.0027",
        (370, 1226): "P2: 707.0912 0 601.8873 46.89 0 707.0912 183.1104 0.1179 0 0 1 0.0062",
    }
    for size, line in odometry.items():
        assert calibration(tmp_path, f"{line}\n{TR}").image_size == size
    own_size = f"{odometry[376, 1241]}\n{TR}\nsize: 1220 370"  # cropped
    assert calibration(tmp_path, own_size).image_size == (370, 1220)


@pytest.mark.parametrize("size", [(370, 1226), (185, 613), (124, 410), (33, 2000)])
@pytest.mark.parametrize("fov", [None, 90.0])
def test_written_calibrations_know_the_size_of_their_images(tmp_path, size, fov):
    write_calibration(tmp_path / "calib.txt", kitti_camera(size, fov))
    assert read_calibration(tmp_path / "calib.txt").image_size == size
    assert ("size" in (tmp_path / "calib.txt").read_text()) == (fov is not None)


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
