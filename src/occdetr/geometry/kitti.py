"""KITTI's colour camera and its calibration files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from occdetr.errors import InputError, Range
from occdetr.files import write_if_changed
from occdetr.geometry.camera import Camera, resize_camera

KITTI_IMAGE_SIZE = (370, 1226)  # height, width of the images of KITTI odometry's sequences 04-10

# P2 and Tr of the same sequences.
_PROJECTION = (
    (707.0912, 0.0, 601.8873, 46.88783),
    (0.0, 707.0912, 183.1104, 0.1178601),
    (0.0, 0.0, 1.0, 0.006203223),
)
_LIDAR_TO_CAMERA = (
    (-0.001857739385241, -0.9999659513510, -0.008039975204516, -0.004784029760483),
    (-0.006481465826011, 0.008051860151134, -0.9999466081774, -0.07337429464231),
    (0.9999773098287, -0.001805528627661, -0.006496203536139, -0.3339968064433),
    (0.0, 0.0, 0.0, 1.0),
)


FIELD_OF_VIEW = Range(10, 150)  # degrees


def kitti_camera(
    image_size: tuple[int, int] = KITTI_IMAGE_SIZE, horizontal_fov: float | None = None
) -> Camera:
    """A camera mounted as KITTI's, with images of ``image_size`` (height, width).

    ``horizontal_fov`` in degrees; None gives KITTI's intrinsics, scaled to the image size.
    """
    height, width = image_size
    camera = Camera(np.array(_PROJECTION), np.array(_LIDAR_TO_CAMERA), KITTI_IMAGE_SIZE)
    if horizontal_fov is None:
        return resize_camera(camera, image_size)
    focal = 0.5 * width / math.tan(math.radians(horizontal_fov) / 2)
    projection = np.zeros((3, 4))
    projection[0, 0] = projection[1, 1] = focal
    projection[:2, 2] = (width - 1) / 2, (height - 1) / 2
    projection[2, 2] = 1.0
    return Camera(projection, camera.lidar_to_camera, image_size)


def read_camera(path: Path | str, image_size: tuple[int, int]) -> Camera:
    """The camera of ``P2`` and ``Tr`` in a KITTI odometry ``calib.txt``; other lines are ignored.

    ``image_size`` (height, width) is that of the images taken with it: the file does not hold it.
    Raises ``InputError`` if the file or one of the lines is missing or is not 12 finite numbers.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: calibration file is missing") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: calibration file cannot be read ({error})") from None
    lines = {
        name.strip(): rest for name, _, rest in (line.partition(":") for line in text.split("\n"))
    }
    projection = _calibration_matrix(path, lines, "P2", "camera 2's 3 x 4 projection")
    transform = _calibration_matrix(path, lines, "Tr", "the 3 x 4 transform LiDAR -> camera")
    if projection[0, 0] <= 0 or projection[1, 1] <= 0:
        raise InputError(f"{path}: line 'P2:' has no positive focal lengths: correct it")
    return Camera(projection, np.vstack([transform, [0.0, 0.0, 0.0, 1.0]]), image_size)


def _calibration_matrix(
    path: Path | str, lines: dict[str, str], name: str, meaning: str
) -> Float[np.ndarray, "3 4"]:
    if name not in lines:
        raise InputError(f"{path}: line '{name}:' is missing: add it ({meaning})")
    try:
        values = np.array([float(word) for word in lines[name].split()])
    except ValueError:
        values = np.array([np.nan])
    if values.size != 12 or not np.isfinite(values).all():
        raise InputError(f"{path}: line '{name}:' must hold 12 numbers ({meaning}): correct it")
    return values.reshape(3, 4)


def write_calibration(path: Path | str, camera: Camera) -> None:
    """Write ``P2`` and ``Tr`` with all digits, so that reading returns the same numbers.

    A file that says the same already is left alone.
    """
    matrices = {"P2": camera.projection, "Tr": camera.lidar_to_camera[:3]}
    lines = [
        f"{name}: " + " ".join(f"{value:.16e}" for value in np.asarray(matrix).ravel())
        for name, matrix in matrices.items()
    ]
    write_if_changed(path, ("\n".join(lines) + "\n").encode())
