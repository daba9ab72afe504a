"""Ambient occlusion of the ground by the solids on and above it (numba)."""

from __future__ import annotations

import math
from typing import no_type_check

import cv2
import numba
import numpy as np
from jaxtyping import Float32

from occdetr.streets.ground import CELL
from occdetr.streets.scene import Solids
from occdetr.streets.solids import BOX, LEAFY_BOX, LEAFY_ELLIPSOID
from occdetr.streets.trace import Index

STEP = 2  # side of an occlusion map's cell, in cells of the terrain's raster
BLUR = 0.3  # metres, standard deviation of the blur of the occlusion map


def sky_visibility(solids: Solids, index: Index) -> Float32[np.ndarray, "x y"]:
    """The share of the sky's light (0-1) that reaches the ground, at every ``STEP``-th cell of the
    terrain's raster."""
    heights = np.ascontiguousarray(index.heights[::STEP, ::STEP])
    hidden = np.zeros(heights.shape, dtype=np.float32)
    _occlude(solids.geometry, solids.forms, heights, index.origin, hidden)
    return 1.0 - cv2.GaussianBlur(hidden, (0, 0), BLUR / (STEP * CELL))


@numba.njit(cache=True, nogil=True)
@no_type_check
def _occlude(geometry, forms, heights, origin, hidden):
    size = STEP * CELL
    for solid in range(len(forms)):
        g, boxy = geometry[solid], forms[solid] == BOX or forms[solid] == LEAFY_BOX
        reach = math.sqrt(g[5] * g[5] + g[6] * g[6]) if boxy else max(g[5], g[6])
        low_i = max(int((g[0] - reach - origin[0]) / size), 0)
        low_j = max(int((g[1] - reach - origin[1]) / size), 0)
        high_i = min(int((g[0] + reach - origin[0]) / size) + 2, heights.shape[0])
        high_j = min(int((g[1] + reach - origin[1]) / size) + 2, heights.shape[1])
        for i in range(low_i, high_i):
            for j in range(low_j, high_j):
                dx, dy = origin[0] + i * size - g[0], origin[1] + j * size - g[1]
                x, y = (g[3] * dx + g[4] * dy) / g[5], (g[3] * dy - g[4] * dx) / g[6]
                if max(abs(x), abs(y)) > 1.0 or (not boxy and x * x + y * y > 1.0):
                    continue
                gap = max(g[2] - g[7] - heights[i, j], 0.0)
                dark = 0.85 * math.exp(-2.5 * gap)
                if forms[solid] >= LEAFY_ELLIPSOID:
                    dark = max(dark, 0.3 * math.exp(-0.25 * gap))
                hidden[i, j] = max(hidden[i, j], dark)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def interpolate(values, origin, x, y):
    """The value at (x, y) of a map of every ``STEP``-th cell, bilinear."""
    u, v = (x - origin[0]) / (STEP * CELL), (y - origin[1]) / (STEP * CELL)
    u = min(max(u, 0.0), values.shape[0] - 1.001)
    v = min(max(v, 0.0), values.shape[1] - 1.001)
    i, j = int(u), int(v)
    u, v = u - i, v - j
    low = values[i, j] * (1 - v) + values[i, j + 1] * v
    return low * (1 - u) + (values[i + 1, j] * (1 - v) + values[i + 1, j + 1] * v) * u
