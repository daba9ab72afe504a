"""Hashes and smooth noise of positions, for relief, leaves and textures (numba)."""

from __future__ import annotations

import math
from typing import no_type_check

import numba


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def hash3(x, y, z):
    """A pseudo-random number in [0, 1) for three integers."""
    value = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    value = ((value ^ (value >> 13)) * 1274126177) & 0x7FFFFFFF
    value = ((value ^ (value >> 15)) * 668265263) & 0x7FFFFFFF
    return ((value ^ (value >> 16)) & 0xFFFF) / 65536.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def smooth2(x, y, cell, seed):
    """Noise over a plane in [-0.5, 0.5), interpolated between grid points ``cell`` metres apart."""
    x, y = x / cell, y / cell
    i, j = math.floor(x), math.floor(y)
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    low = hash3(i, j, seed) * (1 - u) + hash3(i + 1, j, seed) * u
    high = hash3(i, j + 1, seed) * (1 - u) + hash3(i + 1, j + 1, seed) * u
    return low * (1 - v) + high * v - 0.5
