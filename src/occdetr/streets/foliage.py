"""Foliage: which small cells of a solid contain leaves, and where rays hit them (numba).

Crowns are cut out of a periodic field of tufts, which ``textures.py`` also uses for their
brightness. Leaves are concentrated around random centres about half a metre apart (Worley, "A
cellular texture basis function", 1996). The field is tabulated, because a ray reads it at every
step through a crown.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba
import numpy as np
from scipy.spatial import KDTree

from occdetr.streets.intersect import slab, span_ellipsoid
from occdetr.streets.noise import hash3
from occdetr.streets.solids import LEAFY_BOX, LEAFY_CONE, LEAFY_ELLIPSOID

LEAF = 0.13  # side of a cell in metres
PLATE = 0.105  # metres from the centre of a plate to its corners
PERIOD = 32  # cells of ``LEAF`` after which the field repeats
TUFTS = 7  # along each side of the period


def _tabulate() -> tuple[np.ndarray, np.ndarray]:
    """Distance to the nearest tuft's centre and a random tone of that tuft, both 0-255."""
    rng = np.random.default_rng(11)
    corners = np.indices((TUFTS,) * 3).reshape(3, -1).T
    middles = (corners + rng.uniform(0, 0.95, corners.shape)) * (PERIOD / TUFTS)
    cells = np.indices((PERIOD,) * 3).reshape(3, -1).T + 0.5
    distances, nearest = KDTree(middles, boxsize=PERIOD).query(cells)
    tones = rng.integers(0, 256, len(middles))[nearest]
    shape = (PERIOD,) * 3
    far = np.quantile(distances, 0.995)
    scaled = np.clip(255 * distances / far, 0, 255)
    return scaled.astype(np.uint8).reshape(shape), tones.astype(np.uint8).reshape(shape)


DISTANCES, TONES = _tabulate()


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _place(i, j, k, number):
    """The index in the field of a cell of a solid's raster of leaves, shifted for each solid."""
    last = PERIOD - 1
    return (i + 5 * number) & last, (j + 11 * number) & last, (k + 19 * number) & last


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def tuft_at(i, j, k, number):
    """0 at the centre of a tuft to 1 between tufts, for a cell of a solid's raster of leaves."""
    return DISTANCES[_place(i, j, k, number)] / 255.0


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def tone_at(i, j, k, number):
    """The tone in [0, 1] of the tuft that a cell belongs to."""
    return TONES[_place(i, j, k, number)] / 255.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def leaf_in(g, form, number, i, j, k):
    """Whether cell (i, j, k) of a solid's raster of leaves contains leaves."""
    x, y, z = (i + 0.5) * LEAF, (j + 0.5) * LEAF, (k + 0.5) * LEAF
    least = min(g[5], g[6], g[7])
    rim = min(0.55, 0.5 * least)  # width of the crown's loose rim in metres
    if form == LEAFY_BOX:
        depth = min(g[5] - abs(x), g[6] - abs(y), g[7] - abs(z))
        rim = 0.13
    elif form == LEAFY_CONE:
        out = math.sqrt(x * x / (g[5] * g[5]) + y * y / (g[6] * g[6]))
        width = 0.5 - 0.5 * z / g[7]
        tier = (z + 0.4 * out * least) / 0.55  # drooping tiers of branches
        depth = (width * (1.0 - 0.3 * (tier - math.floor(tier))) - out) * least
        rim = min(0.45, 0.3 * least) * width
    else:
        out = x * x / (g[5] * g[5]) + y * y / (g[6] * g[6]) + z * z / (g[7] * g[7])
        if out >= 1.0:
            return False
        depth = (1.0 - math.sqrt(out)) * least
    if depth <= 0.0:
        return False
    tuft = tuft_at(i, j, k, number)
    if tuft * rim > 0.3 * rim + 0.7 * depth:
        return False
    return hash3(i, j, k + 977 * number) < g[11] * (1.35 - 0.7 * tuft + 0.5 * depth)


@numba.njit(cache=True, nogil=True)
@no_type_check
def intersect_leaves(g, form, number, x, y, z, u, v, w, start, best):
    """The first leaf on a ray; each cell with leaves has two crossed plates."""
    near, far = start, best
    if form == LEAFY_ELLIPSOID:
        enter, leave = span_ellipsoid(g, x, y, z, u, v, w)
        near, far = max(near, enter), min(far, leave)
    else:
        near, far = slab(x, u, g[5], near, far)
        near, far = slab(y, v, g[6], near, far)
        near, far = slab(z, w, g[7], near, far)
    if near >= far:
        return math.inf, 0.0, 0.0, 1.0
    px, py, pz = (x + near * u) / LEAF, (y + near * v) / LEAF, (z + near * w) / LEAF
    i, j, k = math.floor(px), math.floor(py), math.floor(pz)
    a, b, c = (1 if u > 0 else -1), (1 if v > 0 else -1), (1 if w > 0 else -1)
    step_x = LEAF / abs(u) if u != 0.0 else math.inf
    step_y = LEAF / abs(v) if v != 0.0 else math.inf
    step_z = LEAF / abs(w) if w != 0.0 else math.inf
    next_x = near + (i + (a > 0) - px) * LEAF / u if u != 0.0 else math.inf
    next_y = near + (j + (b > 0) - py) * LEAF / v if v != 0.0 else math.inf
    next_z = near + (k + (c > 0) - pz) * LEAF / w if w != 0.0 else math.inf
    while near < far:
        if leaf_in(g, form, number, i, j, k):
            t, nx, ny, nz = _intersect_plates(number, i, j, k, x, y, z, u, v, w, start)
            if t < best:  # normals point outwards and up, with a random part
                ax, ay, az = (x + t * u) / g[5], (y + t * v) / g[6], (z + t * w) / g[7]
                side = math.copysign(0.5, nx * ax + ny * ay + nz * (az + 0.3))
                nx, ny, nz = ax + side * nx, ay + side * ny, az + 0.3 + side * nz
                return t, nx, ny, nz
        near = min(next_x, next_y, next_z)
        if next_x <= next_y and next_x <= next_z:
            i += a
            next_x += step_x
        elif next_y <= next_z:
            j += b
            next_y += step_y
        else:
            k += c
            next_z += step_z
    return math.inf, 0.0, 0.0, 1.0


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _intersect_plates(number, i, j, k, x, y, z, u, v, w, start):
    """The nearer hit of a ray with a cell's two plates of leaves, which are polygons with random
    orientations."""
    bits = int(65536 * hash3(j, k, i + 31 * number))
    nx, ny = (bits & 31) / 15.5 - 1.0, ((bits >> 5) & 31) / 15.5 - 1.0
    nz = (bits >> 10) / 31.5 - 1.0
    ex, ey, ez = x - (i + 0.5) * LEAF, y - (j + 0.5) * LEAF, z - (k + 0.5) * LEAF
    shift = 0.25 * LEAF
    best, ax, ay, az = math.inf, 0.0, 0.0, 1.0
    for _ in range(2):
        ex, ey, ez = ex + shift * ny, ey + shift * nz, ez + shift * nx
        speed = nx * u + ny * v + nz * w
        if abs(speed) > 1e-6:
            t = -(nx * ex + ny * ey + nz * ez) / speed
            reach = abs(ex + t * u) + abs(ey + t * v) + abs(ez + t * w)
            if start <= t < best and reach < PLATE:
                best, ax, ay, az = t, nx, ny, nz
        ex, ey, ez = ex - 2 * shift * ny, ey - 2 * shift * nz, ez - 2 * shift * nx
        nx, ny, nz = nz, nx, -ny
    return best, ax, ay, az
