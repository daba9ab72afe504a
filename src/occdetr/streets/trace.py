"""Exact ray tracing through a street's solids and ground, compiled with numba.

A horizontal grid lists the solids above each cell. A ray traverses the cells and is intersected
with the solids listed there, and with the ground's raster where the ray is low enough.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import cv2
import numba
import numpy as np
from jaxtyping import Float, Float32, Int32

from occdetr.streets.foliage import intersect_leaves
from occdetr.streets.ground import CELL, Terrain
from occdetr.streets.intersect import (
    intersect_box,
    intersect_cylinder,
    intersect_wheel,
    span_ellipsoid,
)
from occdetr.streets.scene import Solids
from occdetr.streets.solids import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    WHEEL,
)

COARSE = 8  # side of an index cell in raster cells
START = 0.02  # minimum distance of a hit from the ray's origin in metres
NOTHING, GROUND = -2, -1


class Index(NamedTuple):
    """The spatial index of solids and ground."""

    geometry: np.ndarray
    forms: np.ndarray
    starts: np.ndarray  # (cells + 1): start of each cell's list in ``items``
    items: np.ndarray
    tops: np.ndarray  # (x, y): metres above which a cell is empty
    grounds: np.ndarray  # (x, y): highest ground of a cell
    heights: np.ndarray  # (x, y) of the raster
    origin: np.ndarray  # (x, y) of the raster's first cell's centre


class Hits(NamedTuple):
    """The first hits of rays: a solid's index, ``GROUND`` or ``NOTHING``, distances and normals."""

    solids: Int32[np.ndarray, " ray"]
    distances: Float32[np.ndarray, " ray"]
    normals: Float32[np.ndarray, "ray 3"]


def build_index(solids: Solids, terrain: Terrain) -> Index:
    """Build the spatial index of the solids at one time."""
    width, depth = (n // COARSE for n in terrain.heights.shape)
    highest = cv2.dilate(
        terrain.heights, np.ones((3, 3))
    )  # a cell extends to the centres of its neighbours
    blocks = highest[: width * COARSE, : depth * COARSE].reshape(width, COARSE, depth, COARSE)
    grounds = blocks.max(axis=(1, 3)) + np.float32(0.002)
    tops = grounds.copy()
    boxes = _reach(solids.geometry, solids.forms)
    size = CELL * COARSE
    low = np.floor((boxes[:, 0] - terrain.origin) / size).astype(np.int64)
    high = np.floor((boxes[:, 1] - terrain.origin) / size).astype(np.int64)
    low = np.clip(low, 0, (width, depth))
    high = np.clip(high, -1, (width - 1, depth - 1))
    starts = np.zeros(width * depth + 1, dtype=np.int64)
    items = _list_cells(low, high, solids.geometry, tops, starts)
    return Index(
        *(solids.geometry, solids.forms, starts, items, tops, grounds, terrain.heights),
        np.array(terrain.origin),
    )


def trace(
    index: Index, origins: Float[np.ndarray, "ray 3"], directions: Float[np.ndarray, "ray 3"]
) -> Hits:
    """The first hits of rays (world frame, unit directions)."""
    count = len(directions)
    hits = Hits(
        np.full(count, NOTHING, dtype=np.int32),
        np.full(count, np.inf, dtype=np.float32),
        np.zeros((count, 3), dtype=np.float32),
    )
    stamps = np.full(len(index.forms), -1, dtype=np.int64)
    _trace(index, origins, directions, stamps, *hits)
    return hits


def lit(
    index: Index, points: Float[np.ndarray, "point 3"], sun: Float[np.ndarray, " 3"]
) -> Float32[np.ndarray, " point"]:
    """1 where no solid is between a point and the sun (unit vector towards it), else 0."""
    result = np.ones(len(points), dtype=np.float32)
    stamps = np.full(len(index.forms), -1, dtype=np.int64)
    _shadow(index, points, sun, stamps, result)
    return result


def _reach(geometry: np.ndarray, forms: np.ndarray) -> np.ndarray:
    """(solid, 2, 2): minimum and maximum of x and y of each solid."""
    half = geometry[:, 5:8].copy()
    wide = np.maximum(geometry[:, 8:10], 1.0)
    half[:, 0] = np.where(
        forms == BOX, half[:, 0] * (wide[:, 0] + np.abs(geometry[:, 10])), half[:, 0]
    )
    half[:, 1] = np.where(forms == BOX, half[:, 1] * wide[:, 1], half[:, 1])
    round_ = forms == CYLINDER
    half[round_, :2] *= wide[round_, :1]
    cos, sin = np.abs(geometry[:, 3]), np.abs(geometry[:, 4])
    x = cos * half[:, 0] + sin * half[:, 1]
    y = sin * half[:, 0] + cos * half[:, 1]
    extent = np.stack([x, y], axis=1) + 0.02
    return np.stack([geometry[:, :2] - extent, geometry[:, :2] + extent], axis=1)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _list_cells(low, high, geometry, tops, starts):
    depth = tops.shape[1]
    for solid in range(len(low)):
        top = geometry[solid, 2] + geometry[solid, 7] + 0.01
        for i in range(low[solid, 0], high[solid, 0] + 1):
            for j in range(low[solid, 1], high[solid, 1] + 1):
                starts[i * depth + j + 1] += 1
                tops[i, j] = max(tops[i, j], top)
    for cell in range(1, len(starts)):
        starts[cell] += starts[cell - 1]
    items = np.empty(starts[-1], dtype=np.int32)
    used = starts[:-1].copy()
    for solid in range(len(low)):
        for i in range(low[solid, 0], high[solid, 0] + 1):
            for j in range(low[solid, 1], high[solid, 1] + 1):
                cell = i * depth + j
                items[used[cell]] = solid
                used[cell] += 1
    return items


@numba.njit(cache=True, nogil=True)
@no_type_check
def _trace(index, origins, directions, stamps, found, distances, normals):
    for ray in range(len(directions)):
        o, d = origins[ray], directions[ray]
        solid, t, nx, ny, nz = _walk(
            index, o[0], o[1], o[2], d[0], d[1], d[2], START, 200.0, stamps, ray, False
        )
        if solid != NOTHING:
            found[ray], distances[ray] = solid, t
            normals[ray, 0], normals[ray, 1], normals[ray, 2] = nx, ny, nz


@numba.njit(cache=True, nogil=True)
@no_type_check
def _shadow(index, points, sun, stamps, result):
    for i in range(len(points)):
        p = points[i]
        solid, _, _, _, _ = _walk(
            index, p[0], p[1], p[2], sun[0], sun[1], sun[2], START, 45.0, stamps, i, True
        )
        if solid != NOTHING:
            result[i] = 0.0


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _walk(index, ox, oy, oz, dx, dy, dz, start, limit, stamps, stamp, any_hit):
    """First hit of one ray beyond ``start``: (solid, distance, normal)."""
    size = CELL * COARSE
    width, depth = index.tops.shape
    x0, y0 = index.origin[0], index.origin[1]
    best, solid, nx, ny, nz = limit, NOTHING, 0.0, 0.0, 1.0
    px, py = (ox - x0) / size, (oy - y0) / size
    i, j = math.floor(px), math.floor(py)
    ix = 1 if dx > 0 else -1
    iy = 1 if dy > 0 else -1
    step_x = size / abs(dx) if dx != 0.0 else math.inf
    step_y = size / abs(dy) if dy != 0.0 else math.inf
    next_x = ((i + (ix > 0)) - px) * size / dx if dx != 0.0 else math.inf
    next_y = ((j + (iy > 0)) - py) * size / dy if dy != 0.0 else math.inf
    enter = 0.0
    while 0 <= i < width and 0 <= j < depth and enter < best:
        leave = min(next_x, next_y)
        lowest = oz + dz * (leave if dz < 0.0 else enter)
        if lowest < index.tops[i, j]:
            cell = i * depth + j
            for item in range(index.starts[cell], index.starts[cell + 1]):
                s = index.items[item]
                if stamps[s] == stamp:
                    continue
                stamps[s] = stamp
                t, ax, ay, az = _intersect(
                    index.geometry[s], index.forms[s], s, ox, oy, oz, dx, dy, dz, start, best
                )
                if t < best:
                    best, solid, nx, ny, nz = t, s, ax, ay, az
                    if any_hit:
                        return solid, best, nx, ny, nz
            if lowest < index.grounds[i, j]:
                t = _intersect_ground(
                    index, ox, oy, oz, dx, dy, dz, max(enter, start), min(leave, best)
                )
                if t < best:
                    best, solid = t, GROUND
                    nx, ny, nz = _slope(index, ox + t * dx, oy + t * dy)
                    return solid, best, nx, ny, nz
        enter = leave
        if next_x < next_y:
            i += ix
            next_x += step_x
        else:
            j += iy
            next_y += step_y
    return solid, best, nx, ny, nz


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _height(index, x, y):
    """Height of the ground, interpolated."""
    u, v = (x - index.origin[0]) / CELL, (y - index.origin[1]) / CELL
    width, depth = index.heights.shape
    i, j = int(u), int(v)
    i, j = min(max(i, 0), width - 2), min(max(j, 0), depth - 2)
    u, v = min(max(u - i, 0.0), 1.0), min(max(v - j, 0.0), 1.0)
    h = index.heights
    low = h[i, j] * (1 - v) + h[i, j + 1] * v
    return low * (1 - u) + (h[i + 1, j] * (1 - v) + h[i + 1, j + 1] * v) * u


@numba.njit(cache=True, nogil=True)
@no_type_check
def _slope(index, x, y):
    """The ground's unit normal."""
    gx = (_height(index, x + CELL / 2, y) - _height(index, x - CELL / 2, y)) / CELL
    gy = (_height(index, x, y + CELL / 2) - _height(index, x, y - CELL / 2)) / CELL
    length = math.sqrt(gx * gx + gy * gy + 1.0)
    return -gx / length, -gy / length, 1.0 / length


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _intersect_ground(index, ox, oy, oz, dx, dy, dz, near, far):
    """Distance at which a ray passes below the ground between two distances, else infinity."""
    if near >= far:
        return math.inf
    flat = math.sqrt(dx * dx + dy * dy)
    steps = min(int((far - near) * flat / CELL) + 1, 24)
    step = (far - near) / steps
    before = oz + near * dz - _height(index, ox + near * dx, oy + near * dy)
    t = near
    for _ in range(steps):
        t += step
        after = oz + t * dz - _height(index, ox + t * dx, oy + t * dy)
        if after < 0.0:
            if before <= 0.0:
                return t - step
            return t - step * after / (after - before)
        before = after
    return math.inf


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _intersect(g, form, number, ox, oy, oz, dx, dy, dz, start, best):
    """(distance, normal) of a ray's hit with a solid between two distances, else infinity."""
    rx, ry, rz = ox - g[0], oy - g[1], oz - g[2]
    cos, sin = g[3], g[4]
    x, y, z = cos * rx + sin * ry, cos * ry - sin * rx, rz
    u, v, w = cos * dx + sin * dy, cos * dy - sin * dx, dz
    if form == BOX:
        t, nx, ny, nz = intersect_box(g, x, y, z, u, v, w, start)
    elif form == CYLINDER:
        t, nx, ny, nz = intersect_cylinder(g, x, y, z, u, v, w, start)
    elif form == WHEEL:
        t, nx, ny, nz = intersect_wheel(g, x, y, z, u, v, w, start)
    elif form == ELLIPSOID:
        near, _ = span_ellipsoid(g, x, y, z, u, v, w)
        t, nx, ny, nz = (near if near >= start else math.inf), 0.0, 0.0, 1.0
        if t < best:
            nx, ny, nz = (x + t * u) / g[5] ** 2, (y + t * v) / g[6] ** 2, (z + t * w) / g[7] ** 2
    else:
        t, nx, ny, nz = intersect_leaves(g, form, number, x, y, z, u, v, w, start, best)
    if t >= best:
        return math.inf, 0.0, 0.0, 0.0
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / length, ny / length, nz / length
    return t, cos * nx - sin * ny, sin * nx + cos * ny, nz
