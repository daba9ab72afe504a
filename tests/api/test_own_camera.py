"""Cameras of one's own: mounts, and the files that describe lenses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from occdetr.api.camera import Camera, Mount
from occdetr.errors import InputError
from occdetr.geometry.camera import transform_points
from occdetr.geometry.kitti import kitti_camera, write_calibration

SIZE = (480, 640)
MATRIX = [[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]
RADTAN = (-0.3, 0.1, 0.001, -0.002)

ROS = """
image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 510, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.3, 0.1, 0.001, -0.002, 0]}
"""
ROS2_TOPIC = """
height: 480
width: 640
distortion_model: equidistant
d: [0.1, 0.0, -0.01, 0.002]
k: [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
"""
KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [500, 510, 320, 240]
  distortion_model: radtan
  distortion_coeffs: [-0.3, 0.1, 0.001, -0.002]
  resolution: [640, 480]
"""


@pytest.mark.parametrize(
    ("text", "distortion", "fisheye"),
    [
        (ROS, (*RADTAN, 0.0), False),
        (ROS2_TOPIC, (0.1, 0.0, -0.01, 0.002), True),
        (KALIBR, RADTAN, False),
    ],
    ids=["ros", "ros2 topic", "kalibr"],
)
def test_files_of_other_programs_describe_the_same_lens(text, distortion, fisheye, tmp_path):
    (tmp_path / "camera.yaml").write_text(text)
    camera = Camera.from_ros(tmp_path / "camera.yaml", height=2.0)
    np.testing.assert_array_equal(camera.projection[:, :3], MATRIX)
    assert camera.image_size == SIZE
    assert (camera.distortion, camera.fisheye) == (distortion, fisheye)
    np.testing.assert_array_equal(camera.grid_to_camera, Mount(height=2.0).grid_to_camera())


def test_output_of_ros_with_several_documents_and_fisheyes_of_opencv_are_read(tmp_path):
    (tmp_path / "a.yaml").write_text(f"---\n{ROS2_TOPIC}---\n{KALIBR}---\n")
    assert Camera.from_ros(tmp_path / "a.yaml").fisheye
    (tmp_path / "b.yaml").write_text(
        ROS.replace("plumb_bob", "''")
        .replace("cols: 5", "cols: 4")
        .replace("-0.002, 0]", "-0.002]")
        + "fisheye_model: 1\nboard: {width: 9}\n"
    )
    assert Camera.from_ros(tmp_path / "b.yaml").fisheye


def test_a_file_of_opencv_is_read_as_it_was_written(tmp_path):
    storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array(MATRIX))
    storage.write("distortion_coefficients", np.array([RADTAN]))
    storage.startWriteStruct("board", cv2.FILE_NODE_MAP)
    storage.write("width", 9)
    storage.endWriteStruct()
    storage.release()
    camera = Camera.from_ros(tmp_path / "camera.yml")
    np.testing.assert_array_equal(camera.projection[:, :3], MATRIX)
    assert (camera.image_size, camera.distortion) == (SIZE, RADTAN)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no named entries"),
        ("a: [", "cannot be read as a calibration"),
        ("width: 3", "has no camera_matrix"),
        (KALIBR.replace("pinhole", "omni"), "camera_model omni is not known"),
        (KALIBR + KALIBR.replace("cam0", "cam1"), "has 2 cameras: keep one"),
        (KALIBR.replace("radtan", "fov"), "distortion_model fov is not known"),
        (KALIBR.replace("[500, ", "[-1, "), "fx and fy above 0"),
        (KALIBR.replace("[-0.3, ", "[.nan, "), "4 distortion coefficients"),
        (ROS.replace("510, 240,", "510,"), "cannot be read as a calibration"),
        (ROS.replace("-0.3, 0.1, ", ""), "3 distortion coefficients"),
        (ROS.replace("[500, 0,", "[500, 9,"), "have a skew"),
        (ROS.replace("image_width: 640", ""), "cannot be read as a calibration"),
        ("camera_matrix: {rows: 3, cols: 3}", "cannot be read as a calibration"),
        (ROS.replace("640", ".inf"), "cannot be read as a calibration"),
        ("[" * 3000, "cannot be read as a calibration"),
        ("[1, 2]", "has no named entries"),
        ("%YAML:1.0\n---\nwidth: 3\n", "has no camera_matrix"),
        ("%YAML:1.0\n---\nwidth: [\n", "cannot be read as a calibration"),
        ("%YAML:1.0\n---\n", "cannot be read as a calibration"),
    ],
)
def test_a_broken_file_is_one_line_that_names_it(text, message, tmp_path):
    file = tmp_path / "camera.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as error:
        Camera.from_ros(file)
    line = str(error.value)
    assert line.startswith(f"{file}: ")
    assert line.count(str(file)) == 1
    assert message in line
    assert "\n" not in line
    with pytest.raises(InputError, match="file is missing"):
        Camera.from_ros(tmp_path / "other.yaml")


@pytest.mark.parametrize(
    ("angles", "point", "pixel"),
    [
        ({}, (10, 0, 0), (320, 240 + 500 * (1.65 - 1.73) / 9.73)),
        ({"pitch": 10}, (10, 0, 0), (320, 320)),  # looks up: things lie lower in the image
        ({"yaw": 10}, (10, 0, 0), (408, 240)),  # looks left: things lie further right
        ({"roll": 10}, (10, -3, 0), (470, 210)),  # clockwise: what is right goes up
    ],
)
def test_angles_turn_the_image_as_they_say(angles, point, pixel):
    mount = Mount(**angles)
    camera = Camera.from_intrinsics(MATRIX, SIZE, **angles)
    np.testing.assert_allclose(camera.grid_to_camera, mount.grid_to_camera())
    ray = transform_points(np.array([point], dtype=float), camera.grid_to_camera)
    pixels, inside = camera.for_image(SIZE).project(ray)
    assert inside.all()
    assert np.abs(pixels[0] - pixel).max() < 12


def test_opencvs_own_output_is_taken():
    flat = Camera.from_intrinsics(MATRIX, SIZE, RADTAN)
    row = Camera.from_intrinsics(np.array(MATRIX), SIZE, np.array([RADTAN]))
    assert row.distortion == flat.distortion == RADTAN


def test_the_grid_lies_as_the_height_says():
    """The ground is 1.73 m below the origin; KITTI's camera is where its calibration has it."""
    center = np.linalg.inv(Mount(height=2.5).grid_to_camera())[:3, 3]
    assert center[2] - 2.5 == pytest.approx(-1.73)
    kitti = np.linalg.inv(kitti_camera().lidar_to_camera)[:3, 3]
    np.testing.assert_allclose(np.linalg.inv(Mount().grid_to_camera())[:3, 3], kitti, atol=0.05)


def test_an_image_of_another_size_is_taken_as_a_resized_one(tmp_path):
    camera = Camera.from_intrinsics(MATRIX, SIZE)
    half = camera.for_image((240, 320))
    ray = np.array([[0.2, 0.1, 1.0]])
    whole = camera.for_image(SIZE).project(ray)[0]
    np.testing.assert_allclose((half.project(ray)[0] + 0.5) * 2 - 0.5, whole)
    with pytest.raises(InputError, match="640 x 360 pixels, its camera 640 x 480"):
        camera.for_image((360, 640))
    write_calibration(tmp_path / "calib.txt", kitti_camera())
    kitti = Camera.from_kitti(tmp_path / "calib.txt")
    np.testing.assert_allclose(kitti.for_image((370, 1226)).projection, kitti_camera().projection)
    assert Camera.from_fov(90).for_image((100, 200)).projection[0, 0] == pytest.approx(100)
    other = Camera(kitti_camera().projection, (376, 1241), grid_to_camera=np.eye(4))
    with pytest.raises(InputError, match="1226 x 370 pixels, its camera 1241 x 376"):
        other.for_image((370, 1226))
    with pytest.warns(UserWarning, match="size of the images .* is not known"):
        Camera(Camera.from_intrinsics(MATRIX, SIZE).projection + 0.0).for_image((481, 641))
    with pytest.raises(InputError, match="give its field of view"):
        Camera().for_image(SIZE)
    with pytest.raises(InputError, match=r"principal point \(0, 0\)"):
        Camera.from_intrinsics([[0.8, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], SIZE).for_image(SIZE)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Camera.from_fov(0), "camera.fov=0"),
        (lambda: Camera.from_fov(200), "camera.fov=200"),
        (lambda: Camera.from_fov(90, height=-1), "camera.height=-1"),
        (lambda: Camera.from_fov(90, pitch=400), "camera.pitch=400"),
        (lambda: Camera.from_intrinsics(np.eye(2), SIZE), "3 x 3 finite numbers"),
        (lambda: Camera.from_intrinsics(MATRIX, (0, 4)), "camera.image_size"),
        (lambda: Camera.from_intrinsics(MATRIX, SIZE, (1.0,)), "1 distortion coefficients"),
        (
            lambda: Camera.from_intrinsics([["a"]], SIZE),
            "give its matrix and distortion as numbers",
        ),
        (
            lambda: Camera.from_intrinsics(MATRIX, SIZE, RADTAN[:2] * 4, fisheye=True),
            "8 distortion coefficients: give 0 or 4",
        ),
    ],
)
def test_impossible_cameras_are_refused(make, message):
    with pytest.raises(InputError) as error:
        make()
    assert message in str(error.value)


def test_a_lens_is_not_followed_beyond_where_its_polynomial_turns_back():
    """Barrel distortion of -0.3 would show rays from far outside of the image again."""
    camera = Camera.from_intrinsics(MATRIX, SIZE, (-0.3, 0.0, 0.0, 0.0)).for_image(SIZE)
    angle = np.radians(np.linspace(0, 84, 300))
    rays = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    pixels, inside = camera.project(rays)
    assert np.isnan(pixels[-1]).all()
    assert (np.diff(pixels[inside, 0]) > 0).all()
    last = angle[inside][-1]
    assert not inside[angle > last].any()
    assert np.degrees(last) < 50
