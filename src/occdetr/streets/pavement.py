"""Textures of the ground: asphalt with markings, repairs and covers, slabs, grass (numba).

Textures are explained in textures.py.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba

from occdetr.streets.ground import SIDEWALK
from occdetr.streets.noise import hash3, smooth2
from occdetr.streets.solids import ASPHALT, GRASS, PARKING, PAVING
from occdetr.streets.textures import fade, matt

PATCH_ROW, COVER_ROW = 13.0, 19.0  # metres of road with at most one repaired patch, one cover
COVER = 0.31  # a manhole cover's radius, metres


@numba.njit(cache=True, nogil=True)
@no_type_check
def _line_paint(along, lateral, plan):
    """1 where the road has white paint, else 0."""
    half_width, center_line, edge_lines = plan.road[4], plan.road[5], plan.road[6]
    crossing = plan.crossing
    if abs(lateral) >= half_width:
        return 0.0
    if crossing[1] > 0.0:
        before = crossing[0] - crossing[1] - along
        if -2 * crossing[1] < before < 0.5:
            return 0.0
        if 1.0 < before < 4.0:  # zebra crossing
            return 1.0 if (lateral % 1.0) < 0.5 else 0.0
    if center_line > 0 and abs(lateral) < 0.08 and (along % 6.0) < 3.2:
        return 1.0
    if edge_lines > 0 and abs(half_width - 0.3 - abs(lateral)) < 0.07:
        return 1.0
    return 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _repairs(along, lateral, half_width, distance, seed):
    """Darkening by repaired patches with tarred edges and by the joint between the lanes."""
    seen = fade(distance, 0.04)
    dark = 0.0
    row = math.floor(along / PATCH_ROW)
    side = seed + (lateral > 0)
    if hash3(row, side, 31) < 0.3:
        long, wide = 0.5 + 2.5 * hash3(row, side, 33), 0.35 + 0.8 * hash3(row, side, 34)
        middle = (row + 0.3 + 0.4 * hash3(row, side, 32)) * PATCH_ROW
        beside = (0.25 + 0.45 * hash3(row, side, 35)) * half_width
        edge = max(abs(along - middle) - long, abs(abs(lateral) - beside) - wide)
        if edge < 0.0:
            dark += 0.22 * (hash3(row, side, 36) - 0.35)
        if abs(edge) < 0.03:
            dark += 0.25 * seen
    joint = abs(lateral - 0.22 - 0.03 * smooth2(along, 0.5, 2.0, 38))
    if joint < 0.025 and smooth2(along, 1.5, 9.0, 39) > -0.1:
        dark += 0.22 * seen
    if (along + seed) % 37.0 < 0.05:
        dark += 0.2 * seen
    return dark


@numba.njit(cache=True, nogil=True)
@no_type_check
def _manhole(along, lateral, half_width, distance, seed):
    """Brightness of a manhole cover or a drain, 0 where there is none."""
    row = math.floor(along / COVER_ROW)
    a = along - (row + 0.2 + 0.6 * hash3(row, 1, seed)) * COVER_ROW
    if hash3(row, 2, seed) < 0.6:
        b = lateral - (hash3(row, 3, seed) - 0.5) * half_width
        away = a * a + b * b
        if away < COVER * COVER:
            if away > (0.86 * COVER) ** 2:
                return 0.55
            stud = (a % 0.08 < 0.04) ^ (b % 0.08 < 0.04)
            return 0.72 + 0.14 * stud * fade(distance, 0.03)
    if abs(a) < 0.25 and abs(half_width - 0.22 - abs(lateral)) < 0.17:
        return 0.75 if (a % 0.07) < 0.035 else 0.35
    return 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _asphalt(x, y, along, lateral, distance, plan, seed):
    fine = (hash3(math.floor(x / 0.03), math.floor(y / 0.03), 3) - 0.5) * fade(distance, 0.03)
    bright = 1.0 + 0.22 * fine + 0.14 * smooth2(x, y, 1.7, 7) + 0.12 * smooth2(x, y, 8.0, 9)
    half_width = plan.road[4]
    if abs(lateral) < half_width:
        track = abs(abs(abs(lateral) - 0.5 * half_width) - 0.75)
        bright -= 0.09 * max(1.0 - track / 0.4, 0.0)  # worn by wheels
        cover = _manhole(along, lateral, half_width, distance, seed)
        if cover > 0.0:
            return matt(cover)
        bright -= _repairs(along, lateral, half_width, distance, seed)
    if smooth2(x, y, 5.0, seed) > 0.17 and abs(smooth2(x, y, 0.9, seed + 1)) < 0.012:
        bright -= 0.14 * fade(distance, 0.015)  # cracks, where the road is worn
    paint = _line_paint(along, lateral, plan) * (0.85 + 0.3 * smooth2(x, y, 0.4, 2))
    return bright, paint, 0.82, 0.82, 0.80, 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _grass(x, y, distance, seed):
    """Blades and tufts, dry patches, and flowers or fallen leaves."""
    seen = fade(distance, 0.03)
    blade = hash3(math.floor(x / 0.02), math.floor(y / 0.05), 4) - 0.5
    tuft = smooth2(x, y, 0.25, 8) * fade(distance, 0.2)
    bright = 1.0 + 0.5 * blade * fade(distance, 0.02) + 0.3 * smooth2(x, y, 1.7, 7) + 0.35 * tuft
    i, j = math.floor(x / 0.06), math.floor(y / 0.06)
    many = smooth2(x, y, 3.0, 13)
    if hash3(i, j, 17) < 0.05 * many + 0.002:
        kind = hash3(i, j, 18)
        if seed % 3 == 0:  # fallen leaves
            return bright, 0.8 * seen, 0.55 + 0.2 * kind, 0.30 + 0.25 * kind, 0.10, 0.0
        if seed % 3 == 1:
            return bright, 0.8 * seen, 0.85, 0.82, (0.75 if kind < 0.6 else 0.15), 0.0
    dry = min(max(2.2 * smooth2(x, y, 4.5, 14) + 0.8 * tuft - 0.2, 0.0), 0.6)
    straw = 0.52 * bright
    return bright, dry, straw, 0.86 * straw, 0.45 * straw, 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def ground_texture(texture, surface, x, y, along, lateral, distance, nz, plan, seed):
    """The texture at a point of the ground."""
    if nz < 0.96 and surface == SIDEWALK:  # the kerb's stone
        stone = (along % 1.0) < 0.02
        return matt(1.25 - 0.3 * stone * fade(distance, 0.02))
    if texture == ASPHALT:
        return _asphalt(x, y, along, lateral, distance, plan, seed)
    if texture == GRASS:
        return _grass(x, y, distance, seed)
    fine = (hash3(math.floor(x / 0.03), math.floor(y / 0.03), 3) - 0.5) * fade(distance, 0.03)
    coarse = smooth2(x, y, 1.7, 7)
    if texture == PAVING:
        joint = (along % 0.5) < 0.025 or (lateral % 0.5) < 0.025
        slab = hash3(math.floor(along / 0.5), math.floor(lateral / 0.5), 5) - 0.5
        seen = fade(distance, 0.08)
        return matt(1.0 + (0.16 * slab - 0.25 * joint) * seen + 0.1 * fine + 0.12 * coarse)
    if texture == PARKING:
        row = math.floor(lateral / 0.12)
        offset = along + 0.12 * (row % 2)
        joint = (lateral % 0.12) < 0.015 or (offset % 0.24) < 0.015
        brick = hash3(math.floor(offset / 0.24), row, 6) - 0.5
        return matt(1.0 + (0.30 * brick - 0.3 * joint) * fade(distance, 0.03) + 0.16 * coarse)
    return matt(1.0 + 0.5 * fine + 0.3 * smooth2(x, y, 0.4, 8) + 0.15 * coarse)
