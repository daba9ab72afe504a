"""Textures of solids: leaves, bark, boards, stones, tiles (numba).

A texture is (brightness of the material's colour, share of a second colour, red, green and blue of
the second colour, gloss). It depends on the position on a surface, so it is the same in all views.
Fine detail fades with distance, as in a camera.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba

from occdetr.streets.facades import facade
from occdetr.streets.foliage import LEAF, tone_at, tuft_at
from occdetr.streets.noise import hash3, smooth2
from occdetr.streets.solids import (
    BARK,
    FENCE,
    GLASS,
    LEAFY_BOX,
    LEAFY_CONE,
    LEAVES,
    METAL,
    PAINT,
    ROOF,
    SIGN,
    STONE,
    WALL,
)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def fade(distance, size):
    """1 where a detail of ``size`` metres is wide enough to be visible, towards 0 far away."""
    return min(1.0, 500.0 * size / max(distance, 1e-3))


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def matt(bright):
    return bright, 0.0, 0.0, 0.0, 0.0, 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _leaves(g, form, number, x, y, z, distance):
    """Leaves: darker between tufts, inside and below; tufts differ in colour."""
    least = min(g[5], g[6], g[7])
    i, j, k = math.floor(x / LEAF), math.floor(y / LEAF), math.floor(z / LEAF)
    if form == LEAFY_BOX:
        depth = min(g[5] - abs(x), g[6] - abs(y), g[7] - abs(z))
    elif form == LEAFY_CONE:
        out = math.sqrt(x * x / (g[5] * g[5]) + y * y / (g[6] * g[6]))
        depth = (0.5 - 0.5 * z / g[7] - out) * least
    else:
        out = x * x / (g[5] * g[5]) + y * y / (g[6] * g[6]) + z * z / (g[7] * g[7])
        depth = (1.0 - math.sqrt(out)) * least
    bright = (1.35 - 0.75 * tuft_at(i, j, k, number)) * (0.95 + 0.25 * z / g[7])
    bright *= max(1.05 - 0.7 * max(depth, 0.0), 0.5)
    bright *= 1.0 + 0.4 * (hash3(i, j, k + number) - 0.5) * fade(distance, 0.1)
    young = 0.22 * tone_at(i, j, k, number)
    return bright, young, 0.36 * bright, 0.38 * bright, 0.10 * bright, 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _masonry(texture, run, up, number, distance):
    """Boards, stones or tiles."""
    if texture == FENCE:
        board = hash3(math.floor(run / 0.14), number, 1) - 0.5
        gap = (run % 0.14) < 0.025
        grain = hash3(math.floor(run / 0.02), math.floor(up / 0.5), 2) - 0.5
        light = (0.3 * board - 0.5 * gap) * fade(distance, 0.05)
        return matt(1.0 + light + 0.15 * grain * fade(distance, 0.02))
    if texture == STONE:
        row = math.floor(up / 0.2)
        offset = run + 0.2 * (row % 2)
        joint = (up % 0.2) < 0.025 or (offset % 0.4) < 0.025
        stone = hash3(math.floor(offset / 0.4), row, number) - 0.5
        rough = 0.15 * smooth2(run, up, 0.12, number) * fade(distance, 0.06)
        return matt(1.0 + (0.35 * stone - 0.25 * joint) * fade(distance, 0.06) + rough)
    row = math.floor(up / 0.22)
    tile = hash3(math.floor(run / 0.2), row, number) - 0.5
    edge = 0.25 if (up % 0.22) < 0.05 else 0.0
    moss = 0.2 * smooth2(run, up, 1.5, number)
    return matt(1.0 + (0.3 * tile - edge) * fade(distance, 0.05) + moss)


@numba.njit(cache=True, nogil=True)
@no_type_check
def solid_texture(texture, g, form, number, p, n, distance):
    """The texture at a point of a solid."""
    rx, ry = p[0] - g[0], p[1] - g[1]
    x, y, z = g[3] * rx + g[4] * ry, g[3] * ry - g[4] * rx, p[2] - g[2]
    if texture == LEAVES:
        return _leaves(g, form, number, x, y, z, distance)
    nx, ny = g[3] * n[0] + g[4] * n[1], g[3] * n[1] - g[4] * n[0]
    front = abs(ny) > abs(nx)
    run, half = (x, g[5]) if front else (y, g[6])
    up = z + g[7]
    if texture == WALL:
        return facade(run, half, up, 2 * g[7], front, number, n[2], distance)
    if texture in (FENCE, STONE, ROOF):
        return _masonry(texture, run, up, number, distance)
    if texture == BARK:
        angle = math.atan2(y, x)
        rough = hash3(math.floor(angle * 6), math.floor(z / 0.25), number) - 0.5
        moss = smooth2(angle, z, 0.7, number)
        return matt(1.0 + 0.5 * rough * fade(distance, 0.04) + 0.3 * moss)
    if texture == PAINT:
        return 1.0, 0.0, 0.0, 0.0, 0.0, 0.45
    if texture == GLASS:
        return 1.0, 0.0, 0.0, 0.0, 0.0, 0.9
    if texture == METAL:
        return 1.0, 0.0, 0.0, 0.0, 0.0, 0.15
    if texture == SIGN:
        rim = abs(y) > 0.82 * g[6] or abs(z) > 0.82 * g[7]
        mark = abs(y) < 0.35 * g[6] and abs(z) < 0.22 * g[7]
        return 1.0, (0.9 if rim or mark else 0.0), 0.82, 0.82, 0.82, 0.05
    return matt(1.0)
