"""KITTI's camera and its calibration files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from occdetr.errors import InputError
from occdetr.files import write_atomically


@dataclass(frozen=True)
class Calibration:
    """A camera: ``projection`` maps camera coordinates in metres to pixels (KITTI's P2, with its
    fourth column), ``lidar_to_camera`` the grid frame to the camera frame (KITTI's Tr)."""

    projection: Float[np.ndarray, "3 4"]
    lidar_to_camera: Float[np.ndarray, "4 4"]


def read_calibration(path: Path | str) -> Calibration:
    """Read ``P2`` and ``Tr`` of a KITTI odometry ``calib.txt``; other lines do not matter.

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
    return Calibration(projection, np.vstack([transform, [0.0, 0.0, 0.0, 1.0]]))


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


def write_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write ``P2`` and ``Tr`` so that they read back exactly."""
    matrices = {"P2": calibration.projection, "Tr": calibration.lidar_to_camera[:3]}
    lines = [
        f"{name}: " + " ".join(f"{value:.16e}" for value in np.asarray(matrix).ravel())
        for name, matrix in matrices.items()
    ]
    write_atomically(path, ("\n".join(lines) + "\n").encode())
