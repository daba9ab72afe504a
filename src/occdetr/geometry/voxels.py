"""The voxel grid of SemanticKITTI: 51.2 x 51.2 x 6.4 m in front of the car, voxels of 0.2 m.

Positions have the order x (forward), y (left), z (up) and one of three units: **metres** in the
grid frame, which is KITTI's LiDAR frame; continuous **voxel units**, in which voxel ``i`` is the
interval ``[i, i + 1)``; and integer **indices**.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

GRID_SHAPE: tuple[int, int, int] = (256, 256, 32)

#: Edge of a voxel in metres.
VOXEL_SIZE = 0.2

#: The grid's lower corner in the LiDAR frame, metres.
GRID_ORIGIN: tuple[float, float, float] = (0.0, -25.6, -2.0)

#: The grid's extent in metres.
GRID_SIZE: tuple[float, float, float] = (51.2, 51.2, 6.4)


def metres_to_voxels(
    points: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Points in metres (grid frame) -> continuous voxel units, float64."""
    return (np.asarray(points, dtype=np.float64) - GRID_ORIGIN) / VOXEL_SIZE


def voxels_to_metres(
    points: Shaped[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Points in continuous voxel units -> metres (grid frame), float64."""
    return np.asarray(points, dtype=np.float64) * VOXEL_SIZE + GRID_ORIGIN


def voxel_centers(
    indices: Int[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Centres of voxels in metres (grid frame), float64."""
    return voxels_to_metres(np.asarray(indices, dtype=np.float64) + 0.5)


def points_to_indices(
    points: Float[np.ndarray, "*batch 3"],
) -> Int[np.ndarray, "*batch 3"]:
    """Indices (int64) of the voxels that contain points (metres).

    Points outside the grid have indices outside it, see ``inside_grid``.
    """
    return np.floor(metres_to_voxels(points)).astype(np.int64)


def inside_grid(
    indices: Int[np.ndarray, "*batch 3"], shape: tuple[int, int, int] = GRID_SHAPE
) -> Bool[np.ndarray, "*batch"]:
    """Which indices are inside a grid."""
    indices = np.asarray(indices)
    return np.all((indices >= 0) & (indices < np.asarray(shape)), axis=-1)


def voxels_to_box(indices: Int[np.ndarray, "voxel 3"]) -> Float[np.ndarray, " 6"]:
    """The bounding box of one or more complete voxels, (centre, size) in metres (grid frame)."""
    lower = voxels_to_metres(indices.min(axis=0))
    upper = voxels_to_metres(indices.max(axis=0).astype(np.int64) + 1)
    return np.concatenate([(lower + upper) / 2, upper - lower])
