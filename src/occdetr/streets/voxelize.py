"""Voxelisation of a street's surfaces in the grid of one pose (numba).

Surfaces are sampled every ``SPACING`` metres. A voxel's class is the majority of its samples, as
SemanticKITTI's is that of its points. A second grid has the samples with random offsets, as a
scanner has errors of its range and of the poses by which sweeps are fused.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, UInt8

from occdetr.geometry.camera import transform_points
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.streets.foliage import LEAF, leaf_in
from occdetr.streets.ground import CELL, Terrain
from occdetr.streets.noise import hash3
from occdetr.streets.scene import Solids
from occdetr.streets.solids import BOX, CYLINDER, ELLIPSOID, WHEEL

SPACING = 0.1
SCATTER = 0.09  # metres, largest error on each axis


class Voxels(NamedTuple):
    """``classes`` of the voxels with surface samples (0 elsewhere), those of the ``scattered``
    samples, and which voxels have only ``leaves``."""

    classes: UInt8[np.ndarray, "256 256 32"]
    scattered: UInt8[np.ndarray, "256 256 32"]
    leaves: Bool[np.ndarray, "256 256 32"]


def voxelize(
    solids: Solids,
    terrain: Terrain,
    surface_classes: UInt8[np.ndarray, " surface"],
    world_to_grid: Float[np.ndarray, "4 4"],
) -> Voxels:
    """The voxels of all surfaces at one time.

    ``world_to_grid`` transforms the world frame to the frame of the grid (metres).
    """
    classes, scattered = (np.zeros(GRID_SHAPE, dtype=np.uint8) for _ in range(2))
    votes, scattered_votes = (np.zeros(GRID_SHAPE, dtype=np.int16) for _ in range(2))
    solid = np.zeros(GRID_SHAPE, dtype=np.bool_)
    origin = np.array(GRID_ORIGIN)
    move = np.ascontiguousarray(world_to_grid[:3], dtype=np.float64)
    grid = (classes, votes, scattered, scattered_votes, solid, move, origin)
    low, high = _extent(world_to_grid)
    start = np.array(terrain.origin)
    cells = np.stack([(low - start) / CELL - 1, (high - start) / CELL + 2]).astype(int)
    cells = np.clip(cells, 0, terrain.heights.shape)
    _vote_ground(terrain.heights, terrain.surfaces, start, cells, surface_classes, grid)
    reach = np.linalg.norm(solids.geometry[:, 5:8], axis=1)[:, None] * 1.5 + VOXEL_SIZE
    places = solids.geometry[:, :2]
    near = np.flatnonzero(((places > low - reach) & (places < high + reach)).all(axis=1))
    _vote_solids(solids.geometry, solids.forms, solids.classes, near, grid)
    return Voxels(classes, scattered, (classes > 0) & ~solid)


def _extent(world_to_grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and maximum of x and y of the grid in the world frame."""
    size = np.array(GRID_SHAPE) * VOXEL_SIZE
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * size
    world = transform_points(corners + GRID_ORIGIN, np.linalg.inv(world_to_grid))[:, :2]
    return world.min(axis=0), world.max(axis=0)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _count(x, y, z, name, classes, votes):
    """Count one vote for a class at a position in voxel units (Boyer and Moore's majority vote);
    returns the voxel's index, or -1 outside the grid."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    width, depth, height = classes.shape
    if i < 0 or j < 0 or k < 0 or i >= width or j >= depth or k >= height:
        return -1, -1, -1
    if votes[i, j, k] == 0:
        classes[i, j, k], votes[i, j, k] = name, 1
    elif classes[i, j, k] == name:
        votes[i, j, k] += 1
    else:
        votes[i, j, k] -= 1
    return i, j, k


@numba.njit(cache=True, nogil=True)
@no_type_check
def _vote(x, y, z, name, leafy, grid):
    """Count one sample of a surface in the world frame."""
    classes, votes, scattered, scattered_votes, solid, move, origin = grid
    gx = move[0, 0] * x + move[0, 1] * y + move[0, 2] * z + move[0, 3] - origin[0]
    gy = move[1, 0] * x + move[1, 1] * y + move[1, 2] * z + move[1, 3] - origin[1]
    gz = move[2, 0] * x + move[2, 1] * y + move[2, 2] * z + move[2, 3] - origin[2]
    gx, gy, gz = gx / VOXEL_SIZE, gy / VOXEL_SIZE, gz / VOXEL_SIZE
    i, j, k = _count(gx, gy, gz, name, classes, votes)
    if i < 0:
        return
    solid[i, j, k] |= not leafy
    a, b, c = int(x * 1000), int(y * 1000), int(z * 1000)
    reach = 2 * SCATTER / VOXEL_SIZE
    gx += reach * (hash3(a, b, c) - 0.5)
    gy += reach * (hash3(b, c, a) - 0.5)
    gz += reach * (hash3(c, a, b) - 0.5)
    _count(gx, gy, gz, name, scattered, scattered_votes)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _vote_ground(heights, surfaces, start, cells, surface_classes, grid):
    for i in range(cells[0, 0], cells[1, 0]):
        for j in range(cells[0, 1], cells[1, 1]):
            x, y = start[0] + i * CELL, start[1] + j * CELL
            _vote(x, y, heights[i, j], surface_classes[surfaces[i, j]], False, grid)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _vote_solids(geometry, forms, classes, chosen, grid):
    for solid in chosen:
        g, form, name = geometry[solid], forms[solid], classes[solid]
        if form == BOX:
            _vote_box(g, name, grid)
        elif form == CYLINDER:
            _vote_cylinder(g, name, grid)
        elif form == WHEEL:
            _vote_wheel(g, name, grid)
        elif form == ELLIPSOID:
            _vote_ellipsoid(g, name, grid)
        else:
            _vote_leaves(g, form, solid, name, grid)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _vote_local(g, x, y, z, name, grid):
    """Count one sample in a solid's frame."""
    _vote(g[0] + g[3] * x - g[4] * y, g[1] + g[4] * x + g[3] * y, g[2] + z, name, False, grid)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _steps(length):
    return max(math.ceil(length / SPACING), 1)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _vote_box(g, name, grid):
    hx, hy, hz = g[5], g[6], g[7]
    nz = _steps(2 * hz)
    for c in range(nz):  # the four sides
        s = (c + 0.5) / nz
        z = hz * (2 * s - 1)
        wx, wy = hx * (1 + (g[8] - 1) * s), hy * (1 + (g[9] - 1) * s)
        middle = g[10] * hx * s
        nx, ny = _steps(2 * wx), _steps(2 * wy)
        for a in range(nx):
            x = middle + wx * (2 * (a + 0.5) / nx - 1)
            _vote_local(g, x, wy, z, name, grid)
            _vote_local(g, x, -wy, z, name, grid)
        for b in range(ny):
            y = wy * (2 * (b + 0.5) / ny - 1)
            _vote_local(g, middle + wx, y, z, name, grid)
            _vote_local(g, middle - wx, y, z, name, grid)
    for top in range(2):
        wx = hx * (g[8] if top else 1.0)
        wy = hy * (g[9] if top else 1.0)
        middle, z = g[10] * hx * top, hz * (2 * top - 1)
        nx, ny = _steps(2 * wx), _steps(2 * wy)
        for a in range(nx):
            for b in range(ny):
                x = middle + wx * (2 * (a + 0.5) / nx - 1)
                _vote_local(g, x, wy * (2 * (b + 0.5) / ny - 1), z, name, grid)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _vote_cylinder(g, name, grid):
    hz, nz = g[7], _steps(2 * g[7])
    for c in range(nz):
        s = (c + 0.5) / nz
        scale = 1 + (g[8] - 1) * s
        around = max(_steps(2 * math.pi * max(g[5], g[6]) * scale), 4)
        for a in range(around):
            angle = 2 * math.pi * (a + 0.5) / around
            x, y = g[5] * scale * math.cos(angle), g[6] * scale * math.sin(angle)
            _vote_local(g, x, y, hz * (2 * s - 1), name, grid)
    _vote_local(g, 0.0, 0.0, hz, name, grid)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _vote_wheel(g, name, grid):
    hole = g[8] if g[8] < 1.0 else 0.0
    rings = _steps(g[5] * (1 - hole))
    for ring in range(rings):
        radius = g[5] * (hole + (1 - hole) * (ring + 1) / rings)
        around = max(_steps(2 * math.pi * radius), 4)
        for a in range(around):
            angle = 2 * math.pi * a / around
            x, z = radius * math.cos(angle), radius * math.sin(angle)
            _vote_local(g, x, g[6], z, name, grid)
            _vote_local(g, x, -g[6], z, name, grid)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _vote_ellipsoid(g, name, grid):
    levels = max(_steps(math.pi * g[7]), 3)
    for c in range(levels):
        tilt = math.pi * (c + 0.5) / levels
        around = max(_steps(2 * math.pi * max(g[5], g[6]) * math.sin(tilt)), 3)
        for a in range(around):
            angle = 2 * math.pi * a / around
            x = g[5] * math.sin(tilt) * math.cos(angle)
            y = g[6] * math.sin(tilt) * math.sin(angle)
            _vote_local(g, x, y, g[7] * math.cos(tilt), name, grid)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _vote_leaves(g, form, number, name, grid):
    reach_x, reach_y = math.ceil(g[5] / LEAF), math.ceil(g[6] / LEAF)
    reach_z = math.ceil(g[7] / LEAF)
    for i in range(-reach_x, reach_x):
        for j in range(-reach_y, reach_y):
            x, y = (i + 0.5) * LEAF, (j + 0.5) * LEAF
            wx, wy = g[0] + g[3] * x - g[4] * y, g[1] + g[4] * x + g[3] * y
            for k in range(-reach_z, reach_z):
                if leaf_in(g, form, number, i, j, k):
                    _vote(wx, wy, g[2] + (k + 0.5) * LEAF, name, True, grid)
