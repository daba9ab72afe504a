"""Results as files for other programs."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from occdetr.classes import CLASS_COLORS, CLASS_NAMES, IGNORE
from occdetr.files import write_atomically
from occdetr.geometry.voxels import GRID_ORIGIN, VOXEL_SIZE, voxel_centers

SUFFIXES = (".png", ".label", ".npz", ".ply")


def write_npz(file: Path, arrays: Mapping[str, NDArray]) -> None:
    """The ``arrays`` of a result, the names of the classes, and the place of the grid in metres."""
    buffer = io.BytesIO()
    contents: dict[str, Any] = {
        **arrays,
        "class_names": np.array(CLASS_NAMES),
        "grid_origin": np.array(GRID_ORIGIN),
        "voxel_size": np.array(VOXEL_SIZE),
    }
    np.savez_compressed(buffer, **contents)
    write_atomically(file, buffer.getvalue())


def write_ply(file: Path, grid: UInt8[NDArray, "x y z"]) -> None:
    """The centres of the occupied voxels as a point cloud in metres, with colour and class."""
    occupied = np.argwhere((grid != 0) & (grid != IGNORE))
    classes = grid[tuple(occupied.T)]
    kinds = [
        *((axis, "<f4") for axis in "xyz"),
        *((c, "u1") for c in ("red", "green", "blue")),
        ("class", "u1"),
    ]
    points = np.empty(len(occupied), dtype=kinds)
    points["x"], points["y"], points["z"] = voxel_centers(occupied).T
    points["red"], points["green"], points["blue"] = CLASS_COLORS[classes].T
    points["class"] = classes
    names = {"<f4": "float", "u1": "uchar"}
    properties = "\n".join(f"property {names[kind]} {name}" for name, kind in kinds)
    count = f"element vertex {len(points)}"
    header = ["ply", "format binary_little_endian 1.0", count, properties, "end_header", ""]
    write_atomically(file, "\n".join(header).encode() + points.tobytes())
