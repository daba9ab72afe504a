"""SemanticKITTI's voxel files, read and written. Writes are atomic."""

from __future__ import annotations

import math
from pathlib import Path
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Shaped, UInt8, UInt16

from occdetr.classes import IGNORE, LEARNING_MAP, LEARNING_MAP_INV, NUM_CLASSES
from occdetr.data.frames import Frame
from occdetr.errors import InputError
from occdetr.files import read_bytes, write_atomically
from occdetr.geometry.voxels import GRID_SHAPE

#: The exact size of each voxel file in bytes.
VOXEL_BYTES = {kind: math.prod(GRID_SHAPE) // 8 for kind in ("bin", "invalid", "occluded")}
VOXEL_BYTES["label"] = math.prod(GRID_SHAPE) * 2

_UNKNOWN = 254  # in the lookup table only: a raw id that is not SemanticKITTI's


def read_mask(path: Path | str) -> Bool[np.ndarray, "256 256 32"]:
    """Read a ``.bin``, ``.invalid`` or ``.occluded`` grid: one bit per voxel, highest bit first."""
    return np.unpackbits(_read_bits(path)).view(bool).reshape(GRID_SHAPE)


def write_mask(path: Path | str, grid: Shaped[np.ndarray, "256 256 32"]) -> None:
    """Write a boolean grid, one bit per voxel, highest bit first."""
    _check_shape(grid)
    write_atomically(path, np.packbits(grid.astype(bool, copy=False)).tobytes())


def read_raw_labels(path: Path | str) -> UInt16[np.ndarray, "256 256 32"]:
    """Read a ``.label`` grid of raw ids (little-endian uint16)."""
    data = _read_grid_bytes(path, VOXEL_BYTES["label"])
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
    invalid: UInt8[np.ndarray, " byte"] | None = None,
    source: Path | str = "labels",
) -> UInt8[np.ndarray, "*grid"]:
    """Raw ids -> classes 0-19, and 255 where nothing is evaluated.

    As in SemanticKITTI's ``evaluate_completion.py``: only raw id 0 is empty. Other raw ids that
    ``learning_map`` maps to 0 become 255, as do ``invalid`` voxels, of which there is one bit each,
    highest first. The number of voxels must be a multiple of 8. ``source`` is named in error
    messages. Raises ``InputError`` on a raw id that is not SemanticKITTI's.
    """
    flat = np.ascontiguousarray(raw).reshape(-1)
    bits = np.zeros(flat.size // 8, np.uint8) if invalid is None else invalid
    labels = np.empty(flat.size, np.uint8)
    words = flat.view(np.uint64).reshape(-1, 2)
    if not _remap(flat.reshape(-1, 8), words, bits, _TO_CLASS, labels.reshape(-1, 8)):
        unknown = flat[_TO_CLASS[flat] == _UNKNOWN]
        raise InputError(
            f"{source}: unknown raw label id {int(unknown.min())}: "
            "expected ids of SemanticKITTI's learning_map"
        )
    return labels.reshape(raw.shape)


@numba.njit(cache=True, nogil=True)
@no_type_check  # numba cannot compile what jaxtyping's import hook wraps
def _remap(raw, words, invalid, table, labels):
    """Fill ``labels``, eight voxels at a time; False if a raw id is unknown.

    Most voxels are empty: eight of them are two zero words. A table look-up of each voxel (np.take)
    takes five times as long.
    """
    known = True
    for i in range(len(invalid)):
        bits = invalid[i]
        if words[i, 0] | words[i, 1] == 0 and (bits == 0 or bits == 255):
            labels[i] = bits
            continue
        for j in range(8):
            label = table[raw[i, j]]
            known &= label != _UNKNOWN
            labels[i, j] = IGNORE if bits >> (7 - j) & 1 else label
    return known


def read_labels(frame: Frame) -> UInt8[np.ndarray, "256 256 32"]:
    """The ground truth of a frame: 0 empty, 1-19 semantic, 255 not evaluated.

    Raises ``InputError`` if a file is missing or broken, or if all voxels are empty although the
    scan (``.bin``, if it is there) has occupied ones.
    """
    path, scan = frame.voxel_file("label"), frame.voxel_file("bin")
    raw = read_raw_labels(path)
    if not raw.view(np.uint64).any() and scan.is_file() and read_mask(scan).any():
        raise InputError(
            f"{path}: has no occupied voxel, but {scan.name} has: copy or download it again"
        )
    return remap_labels(raw, _read_bits(frame.voxel_file("invalid")), source=path)


def write_labels(path: Path | str, labels: Shaped[np.ndarray, "256 256 32"]) -> None:
    """Write classes 0-19 as a prediction file: raw ids through ``learning_map_inv``.

    Raises ``ValueError`` on other values: predictions have no label for "not evaluated".
    """
    if labels.size and (labels.min() < 0 or labels.max() >= NUM_CLASSES):
        raise ValueError(f"{path}: labels must be 0-{NUM_CLASSES - 1}")
    write_raw_labels(path, _TO_RAW[labels])


def _read_bits(path: Path | str) -> UInt8[np.ndarray, " byte"]:
    data = _read_grid_bytes(path, VOXEL_BYTES["invalid"])
    return np.frombuffer(data, dtype=np.uint8)


def _check_shape(grid: np.ndarray) -> None:
    if grid.shape != GRID_SHAPE:
        raise ValueError(f"a grid has shape {GRID_SHAPE}, not {grid.shape}")


def _read_grid_bytes(path: Path | str, expected: int) -> bytes:
    data = read_bytes(path)
    check_bytes(path, expected, len(data))
    return data


def check_bytes(path: Path | str, expected: int, found: int) -> None:
    """Raises ``InputError`` if a file has not the ``expected`` number of bytes."""
    if found != expected:
        state = "truncated" if found < expected else "too long"
        raise InputError(
            f"{path}: file is {state} ({expected:,} bytes expected, {found:,} found): "
            "copy or download it again"
        )
