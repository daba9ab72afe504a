"""The walls of houses: windows, doors, shops, plinths, gutters, bricks or plaster (numba).

The windows, shutters and so on of a house are random numbers seeded by its number. Textures are
explained in textures.py.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba

from occdetr.streets.noise import hash3, smooth2

BURIED = 0.8  # metres of a house's walls below the ground
STOREY, SHOP = 2.8, 2.55  # metres; a shop's window and its sign above end under the first floor
WHITE = 0.84
PANE = 0.75  # gloss


@numba.njit(cache=True, nogil=True)
@no_type_check
def facade(run, half, up, tall, front, number, nz, distance):
    """The texture of a wall at ``run`` metres from its middle and ``up`` metres from its bottom.

    The wall is ``tall`` metres high and twice ``half`` metres wide. Only a ``front`` and the wall
    opposite may have doors and shops."""
    up, tall = up - BURIED, tall - BURIED
    if nz > 0.5 or half < 1.0:  # a chimney
        return _masonry(run, up, number, distance)
    if up > tall - 0.14 or half - abs(run) < 0.07:  # gutter, down pipe
        zinc = 0.30 + 0.3 * hash3(number, 9, 1)
        return 1.0, 0.85, zinc, zinc, zinc, 0.1
    shop = front and tall > 4.5 and half > 4.0 and hash3(number, 8, 1) < 0.3
    if shop and up < STOREY + 0.1:
        return _shop(run, half, up, number, distance)
    bays = max(round(2 * half / (2.2 + 1.3 * hash3(number, 1, 1))), 1)
    bay = 2 * half / bays
    column, storey = math.floor((run + half) / bay), math.floor(up / STOREY)
    beside, level = abs((run + half) - (column + 0.5) * bay), up - storey * STOREY
    top = 2.05 + 0.35 * hash3(number, 4, 1)
    if storey >= 0 and storey * STOREY + top < tall - 0.2:
        wide = 0.40 + 0.35 * hash3(number, 2, 1)
        if front and storey == 0 and hash3(column, number, 4) < 0.25:
            if beside < 0.62 and level < 2.25:
                return _door(beside, level, column, number)
        elif beside < wide + 0.75 and hash3(column, storey, number) < 0.9:
            sill = 0.95 - 0.6 * (hash3(number, 5, 1) < 0.2)
            if beside < wide and sill < level < top:
                side = run + half - (column + 0.5) * bay
                return _window(side, level - sill, wide, top - sill, column, storey, number)
            if beside < wide + 0.1 and sill - 0.08 < level <= sill:
                return 1.0, 0.8, 0.70, 0.69, 0.66, 0.0
            if hash3(number, 6, 1) < 0.5 and beside < wide + 0.09 and sill < level < top + 0.12:
                return 1.0, 0.7, 0.78, 0.76, 0.72, 0.0  # a stone frame
            if hash3(number, 7, 1) < 0.35 and sill < level < top and beside < 2 * wide + 0.04:
                slat = 0.75 + 0.25 * ((level % 0.08) > 0.03)
                red, green, blue = _door_color(number + 3)
                return 1.0, 1.0, slat * red, slat * green, slat * blue, 0.0
    return _masonry(run, up, number, distance)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _door_color(number):
    kind = hash3(number, 3, 5)
    if kind < 0.25:
        return 0.30, 0.17, 0.09
    if kind < 0.42:
        return 0.10, 0.22, 0.14
    if kind < 0.58:
        return 0.12, 0.18, 0.32
    if kind < 0.72:
        return 0.38, 0.09, 0.07
    if kind < 0.86:
        return 0.74, 0.73, 0.70
    return 0.24, 0.25, 0.27


@numba.njit(cache=True, nogil=True)
@no_type_check
def _door(beside, level, column, number):
    if beside > 0.52 or level > 2.15:
        return 1.0, 0.9, WHITE, WHITE, WHITE, 0.0
    red, green, blue = _door_color(number + 7 * column)
    if level > 1.85 or (hash3(number, column, 6) < 0.4 and beside < 0.25 and level > 1.1):
        return 1.0, 1.0, 0.10, 0.11, 0.12, PANE
    groove = abs(beside - 0.30) < 0.02 or abs(level - 1.0) < 0.02 or beside < 0.012
    tone = 0.6 if groove else 1.0
    return 1.0, 1.0, tone * red, tone * green, tone * blue, 0.08


@numba.njit(cache=True, nogil=True)
@no_type_check
def _window(side, level, wide, tall, column, storey, number):
    """A window: frame, bars, curtains, and the shadow of the reveal."""
    beside = abs(side)
    if beside > wide - 0.05 or level < 0.05 or level > tall - 0.05:
        shade = 0.6 if level > tall - 0.05 else (0.8 if side < 0 else 1.0)
        return 1.0, 1.0, shade * WHITE, shade * WHITE, shade * WHITE, 0.0
    bars = hash3(number, 10, 1)
    if beside < 0.03 or (bars < 0.5 and abs(level - 0.68 * tall) < 0.025):
        return 1.0, 1.0, WHITE, WHITE, WHITE, 0.0
    hung = hash3(column + 5, storey, number)
    inside = 0.05 + 0.07 * hash3(column, storey, number + 5)
    if hung < 0.35 and beside > (0.45 + 0.3 * hung) * wide:  # curtains
        fold = 0.42 + 0.16 * ((beside % 0.09) > 0.045)
        return 1.0, 1.0, fold, 0.95 * fold, 0.86 * fold, PANE
    if hung > 0.8 and level > (hung - 0.7) * 3.0 * tall:  # a blind
        slat = 0.45 + 0.15 * ((level % 0.07) > 0.02)
        return 1.0, 1.0, slat, slat, 0.93 * slat, PANE
    if 0.35 < hung < 0.5 and level < 0.45 * tall:  # a net curtain
        return 1.0, 1.0, 0.5, 0.5, 0.5, PANE
    return 1.0, 1.0, inside, inside, 1.1 * inside, PANE


@numba.njit(cache=True, nogil=True)
@no_type_check
def _shop(run, half, up, number, distance):
    """A ground floor with shops: wide panes between pillars, a base, a sign above."""
    front = 2 * half / max(round(half / 2.2), 1)
    which = math.floor((run + half) / front)
    beside = abs(run + half - (which + 0.5) * front)
    red, green, blue = _door_color(number + 11 * which)
    if beside > 0.5 * front - 0.22:
        return _masonry(run, up, number, distance)
    if up > 2.05:
        letter = hash3(math.floor(run / 0.16), which, number) < 0.6 and beside < 0.3 * front
        if letter and 2.28 < up < SHOP:
            ink = 0.15 if green > 0.5 else WHITE
            return 1.0, 1.0, ink, ink, ink, 0.0
        return 1.0, 1.0, 1.3 * red, 1.3 * green, 1.3 * blue, 0.1
    if up < 0.35 or beside > 0.5 * front - 0.30 or up > 1.98 or beside < 0.03:
        return 1.0, 1.0, 0.8 * red, 0.8 * green, 0.8 * blue, 0.1
    lamp = 0.08 + 0.14 * hash3(which, 2, number) + 0.05 * up
    ware = math.floor(run / (0.14 + 0.3 * hash3(which, 5, number)))
    if up < 0.5 + 1.1 * hash3(ware, 6, number) ** 2:  # displayed goods
        red, green, blue = _door_color(number + ware)
        lamp = 2.0 * lamp + 0.15
        return 1.0, 1.0, lamp * (red + 0.3), lamp * (green + 0.3), lamp * (blue + 0.3), PANE
    return 1.0, 1.0, 1.1 * lamp, lamp, 0.85 * lamp, PANE


@numba.njit(cache=True, nogil=True)
@no_type_check
def _masonry(run, up, number, distance):
    """Bricks or plaster, and the plinth below them."""
    stain = 0.10 * smooth2(run, up, 1.6, number) + 0.06 * smooth2(run, 0.3 * up, 0.3, number)
    if up < 0.3 + 0.3 * hash3(number, 11, 1):
        stone = 0.42 + 0.12 * hash3(number, 12, 1) + 0.3 * stain
        return 1.0, 0.8, stone, 0.98 * stone, 0.95 * stone, 0.0
    if hash3(number, 3, 2) < 0.4:
        row = math.floor(up / 0.08)
        offset = run + 0.1 * (row % 2)
        joint = (up % 0.08) < 0.015 or (offset % 0.2) < 0.015
        brick = hash3(math.floor(offset / 0.2), row, number) - 0.5
        seen = min(1.0, 12.0 / max(distance, 1e-3))
        stain += (0.25 * brick - 0.2 * joint) * seen
    return 1.0 + stain, 0.0, 0.0, 0.0, 0.0, 0.0
