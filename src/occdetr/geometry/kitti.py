"""KITTI's colour camera and its calibration files."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from occdetr.errors import InputError, Range
from occdetr.files import read_text, write_if_changed
from occdetr.geometry.camera import Camera, resize_camera

KITTI_CAMERA_HEIGHT = 1.65  # metres above the ground
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

#: fx = fy, cx, cy of P2 in KITTI's recordings, and the (height, width) of their images.
_RECORDINGS = (
    ((721.5377, 609.5593, 172.854), (375, 1242)),  # odometry 03
    ((707.0912, 601.8873, 183.1104), (370, 1226)),  # odometry 04-12
    ((718.856, 607.1928, 185.2157), (376, 1241)),  # odometry 00-02, 13-21
    ((707.0493, 604.0814, 180.5066), (370, 1224)),
    ((718.3351, 600.3891, 181.5122), (374, 1238)),
)

MAX_ROTATION_ERROR = 0.01  # largest element of R R^T - 1, so that two digits after the point do
MAX_ASPECT = 100.0  # of the focal lengths in x and y; resized images may have different ones
MAX_MOUNTING_DISTANCE = 50.0  # metres between LiDAR and camera; more means other units


@dataclass(frozen=True)
class Calibration:
    """What a ``calib.txt`` holds: the camera, and the (height, width) of its images if known."""

    projection: Float[np.ndarray, "3 4"]
    lidar_to_camera: Float[np.ndarray, "4 4"]
    image_size: tuple[int, int] | None


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
    """The camera of a ``calib.txt`` for images of ``image_size`` (height, width), whatever size the
    file says. Raises ``InputError`` as ``read_calibration``."""
    calibration = read_calibration(path)
    return Camera(calibration.projection, calibration.lidar_to_camera, image_size)


def read_calibration(path: Path | str) -> Calibration:
    """``P2``, ``Tr`` and, if it is there, ``size`` of a KITTI odometry ``calib.txt``.

    Other lines are ignored. Without a line ``size: WIDTH HEIGHT`` the image size is known for
    KITTI's own calibrations, also when they were resized. Raises ``InputError``, which names the
    file and the line, if a line is missing, is there twice or does not describe a camera.
    """
    lines: dict[str, str] = {}
    for line in read_text(path):
        name, colon, rest = line.partition(":")
        name = name.strip()
        if colon and name in lines and name in ("P2", "Tr", "size"):
            raise InputError(f"{path}: line '{name}:' is there twice: keep one")
        lines[name] = rest
    projection = _calibration_matrix(path, lines, "P2", "camera 2's 3 x 4 projection")
    transform = _calibration_matrix(path, lines, "Tr", "the 3 x 4 transform LiDAR -> camera")
    _check_projection(path, projection)
    _check_transform(path, transform)
    return Calibration(
        projection,
        np.vstack([transform, [0.0, 0.0, 0.0, 1.0]]),
        _read_size(path, lines["size"]) if "size" in lines else known_image_size(projection),
    )


def known_image_size(projection: Float[np.ndarray, "3 4"]) -> tuple[int, int] | None:
    """(height, width) of the images of one of KITTI's cameras, also of resized ones; else None."""
    (fx, _, cx), (_, fy, cy) = projection[0, :3], projection[1, :3]
    for (focal, center_x, center_y), (height, width) in _RECORDINGS:
        scale_x, scale_y = fx / focal, fy / focal
        expected = (center_x + 0.5) * scale_x - 0.5, (center_y + 0.5) * scale_y - 0.5
        if np.allclose((cx, cy), expected, rtol=1e-5, atol=1e-3):
            return round(height * scale_y), round(width * scale_x)
    return None


def _calibration_matrix(
    path: Path | str, lines: dict[str, str], name: str, meaning: str
) -> Float[np.ndarray, "3 4"]:
    if name not in lines:
        raise InputError(f"{path}: line '{name}:' is missing: add it ({meaning})")
    words = lines[name].split()
    values = [_number(word) for word in words]
    if len(words) != 12 or None in values:
        wrong = [word for word, value in zip(words, values, strict=True) if value is None]
        found = f"{wrong[0][:40]!r} is none" if wrong else f"found {len(words)}"
        raise InputError(
            f"{path}: line '{name}:' must hold 12 numbers ({meaning}), {found}: correct it"
        )
    return np.array(values, dtype=np.float64).reshape(3, 4)


def _number(word: str) -> float | None:
    """A finite decimal number with a point; None for other texts."""
    if not re.fullmatch(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?", word):
        return None
    return float(word) if math.isfinite(float(word)) else None


def _read_size(path: Path | str, text: str) -> tuple[int, int]:
    match = re.fullmatch(r"\s*([1-9][0-9]{0,5})\s+([1-9][0-9]{0,5})\s*", text)
    if match is None:
        raise InputError(
            f"{path}: line 'size:' must hold the width and the height of the images in pixels: "
            "correct it, as in size: 1226 370"
        )
    return int(match[2]), int(match[1])


def _check_projection(path: Path | str, projection: Float[np.ndarray, "3 4"]) -> None:
    if projection[0, 0] <= 0 or projection[1, 1] <= 0:
        raise InputError(f"{path}: line 'P2:' has no positive focal lengths: correct it")
    if not 1 / MAX_ASPECT <= projection[0, 0] / projection[1, 1] <= MAX_ASPECT:
        raise InputError(
            f"{path}: line 'P2:' has the focal lengths {projection[0, 0]:g} and "
            f"{projection[1, 1]:g}, which no camera has: correct it"
        )
    fixed = projection[[1, 2, 2, 2], [0, 0, 1, 2]]
    if not np.allclose(fixed, [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-6):
        raise InputError(
            f"{path}: line 'P2:' is no projection of the form fx s cx tx  0 fy cy ty  0 0 1 tz: "
            "correct it"
        )


def _check_transform(path: Path | str, transform: Float[np.ndarray, "3 4"]) -> None:
    rotation = transform[:, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
        raise InputError(f"{path}: line 'Tr:' has no rotation in its columns 1 to 3: correct it")
    if np.linalg.norm(transform[:, 3]) > MAX_MOUNTING_DISTANCE:
        raise InputError(
            f"{path}: line 'Tr:' moves by more than {MAX_MOUNTING_DISTANCE:.0f} m: give metres"
        )
    if rotation[2, 0] <= 0:
        raise InputError(
            f"{path}: line 'Tr:' has a camera that does not look forward (x of the grid): "
            "give the transform LiDAR -> camera, not its inverse"
        )


def write_calibration(path: Path | str, camera: Camera) -> None:
    """Write ``P2`` and ``Tr`` with all digits, so that reading returns the same numbers, and
    ``size`` if it does not follow from ``P2``.

    A file that says the same already is left alone.
    """
    matrices = {"P2": camera.projection, "Tr": camera.lidar_to_camera[:3]}
    lines = [
        f"{name}: " + " ".join(f"{value:.16e}" for value in np.asarray(matrix).ravel())
        for name, matrix in matrices.items()
    ]
    height, width = camera.image_size
    if known_image_size(np.asarray(camera.projection)) != camera.image_size:
        lines.append(f"size: {width} {height}")
    write_if_changed(path, ("\n".join(lines) + "\n").encode())
