"""SemanticKITTI's files, read and written: images, calibration, voxel grids.

Every writer puts a temporary file beside its goal and renames it, so that no reader sees half a
file.
"""

from __future__ import annotations

import contextlib
import os
import uuid
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8, UInt16

from occdetr.classes import IGNORE, LEARNING_MAP, LEARNING_MAP_INV, NUM_CLASSES
from occdetr.data.frames import Frame
from occdetr.errors import InputError
from occdetr.geometry.voxels import GRID_SHAPE

_UNKNOWN = 254  # in the lookup table only: a raw id that SemanticKITTI does not have


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


def read_image(path: Path | str) -> UInt8[np.ndarray, "height width 3"]:
    """Read a picture as RGB. Raises ``InputError`` if it is missing or cannot be decoded."""
    data = _read_bytes(path)
    # libpng would print its own lines on a truncated file, so look for the end before it does
    complete = data[-12:].find(b"IEND") >= 0 or not data.startswith(b"\x89PNG")
    image = None
    if data and complete:
        with contextlib.suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        state = "cannot be decoded" if complete else "is truncated"
        raise InputError(f"{path}: image {state}: copy or download it again")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def write_image(path: Path | str, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an RGB picture, as PNG or as what the path ends in."""
    ending = Path(path).suffix or ".png"
    _, data = cv2.imencode(ending, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    write_atomically(path, data.tobytes())


def read_mask(path: Path | str) -> Bool[np.ndarray, "256 256 32"]:
    """Read a ``.bin``, ``.invalid`` or ``.occluded`` grid: one bit a voxel, highest bit first."""
    data = _read_grid_bytes(path, int(np.prod(GRID_SHAPE)) // 8)
    return np.unpackbits(np.frombuffer(data, dtype=np.uint8)).view(bool).reshape(GRID_SHAPE)


def write_mask(path: Path | str, grid: Shaped[np.ndarray, "256 256 32"]) -> None:
    """Write a boolean grid, one bit a voxel, highest bit first."""
    _check_shape(grid)
    write_atomically(path, np.packbits(grid.astype(bool, copy=False)).tobytes())


def read_raw_labels(path: Path | str) -> UInt16[np.ndarray, "256 256 32"]:
    """Read a ``.label`` grid of raw ids (little-endian uint16)."""
    data = _read_grid_bytes(path, int(np.prod(GRID_SHAPE)) * 2)
    return np.frombuffer(data, dtype="<u2").reshape(GRID_SHAPE)


def write_raw_labels(path: Path | str, raw: Shaped[np.ndarray, "256 256 32"]) -> None:
    """Write a ``.label`` grid of raw ids (little-endian uint16)."""
    _check_shape(raw)
    write_atomically(path, raw.astype("<u2").tobytes())


def _learning_tables() -> tuple[np.ndarray, np.ndarray]:
    to_class = np.full(2**16, _UNKNOWN, dtype=np.uint8)
    for raw, class_id in LEARNING_MAP.items():
        to_class[raw] = class_id if class_id or raw == 0 else IGNORE
    to_raw = np.array([LEARNING_MAP_INV[i] for i in range(NUM_CLASSES)], dtype=np.uint16)
    return to_class, to_raw


_TO_CLASS, _TO_RAW = _learning_tables()


def remap_labels(
    raw: UInt16[np.ndarray, "*grid"],
    invalid: Bool[np.ndarray, "*grid"] | None = None,
    source: Path | str = "labels",
) -> UInt8[np.ndarray, "*grid"]:
    """Raw ids -> classes 0-19, and 255 where nothing is evaluated.

    As SemanticKITTI's ``evaluate_completion.py``: only raw 0 is empty, every other raw id that
    ``learning_map`` sends to 0 becomes 255, and so do the ``invalid`` voxels. ``source`` is what
    an error names. Raises ``InputError`` on a raw id that SemanticKITTI does not have.
    """
    labels = _TO_CLASS.take(raw, mode="wrap")  # no uint16 is out of the table: do not look
    unknown = labels == _UNKNOWN
    if unknown.any():
        raise InputError(
            f"{source}: unknown raw label id {int(raw[unknown].min())}: "
            "expected ids of SemanticKITTI's learning_map"
        )
    if invalid is not None:
        np.maximum(labels, invalid * np.uint8(IGNORE), out=labels)  # 255; faster than a mask
    return labels


def read_labels(frame: Frame) -> UInt8[np.ndarray, "256 256 32"]:
    """The ground truth of a frame: 0 empty, 1-19 semantic, 255 not evaluated."""
    path = frame.voxel_file("label")
    return remap_labels(read_raw_labels(path), read_mask(frame.voxel_file("invalid")), source=path)


def write_labels(path: Path | str, labels: Shaped[np.ndarray, "256 256 32"]) -> None:
    """Write classes 0-19 as a prediction file: raw ids through ``learning_map_inv``.

    Raises ``ValueError`` on any other value: a prediction has no "not evaluated".
    """
    if labels.size and (labels.min() < 0 or labels.max() >= NUM_CLASSES):
        raise ValueError(f"{path}: labels must be 0-{NUM_CLASSES - 1}")
    write_raw_labels(path, _TO_RAW[labels])


def write_atomically(path: Path | str, data: bytes) -> None:
    """Write a file, and its folder if need be; other processes see all of it or nothing."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _check_shape(grid: np.ndarray) -> None:
    if grid.shape != GRID_SHAPE:
        raise ValueError(f"a grid has shape {GRID_SHAPE}, not {grid.shape}")


def _read_bytes(path: Path | str) -> bytes:
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: file is missing: check the dataset folder") from None
    except OSError as error:
        raise InputError(f"{path}: file cannot be read ({error.strerror})") from None


def _read_grid_bytes(path: Path | str, expected: int) -> bytes:
    data = _read_bytes(path)
    if len(data) != expected:
        state = "truncated" if len(data) < expected else "too long"
        raise InputError(
            f"{path}: file is {state} ({expected:,} bytes expected, {len(data):,} found): "
            "copy or download it again"
        )
    return data
