"""Traffic signs: round, triangular, octagonal and square plates on a pole, and large boards."""

from __future__ import annotations

import math

import numpy as np

from occdetr.streets.parts import Range, ball, tube
from occdetr.streets.solids import BOX, METAL, Color, Material, Shape, Solid

RED, BLUE, YELLOW = (0.72, 0.05, 0.05), (0.06, 0.18, 0.58), (0.90, 0.70, 0.06)
GREEN, WHITE, BLACK = (0.05, 0.36, 0.18), (0.92, 0.92, 0.90), (0.05, 0.05, 0.05)
BACK, POLE = (0.45, 0.46, 0.47), (0.55, 0.56, 0.57)


def traffic_sign(rng: np.random.Generator) -> Shape:
    """One or two plates on a thin pole, or a large board on two posts, facing oncoming traffic."""
    metal = Material("pole", POLE, METAL)
    if rng.random() < 0.12:
        return _board(rng, metal)
    radius, size = float(rng.uniform(0.05, 0.06)), float(rng.uniform(0.32, 0.44))
    x, z = -radius - 0.02, float(rng.uniform(1.95, 2.3)) + size
    faces = (_speed_limit, _no_entry, _mandatory, _warning, _give_way, _stop, _priority, _panel)
    odds = (0.18, 0.10, 0.14, 0.15, 0.12, 0.06, 0.11, 0.14)
    solids, top = faces[rng.choice(len(faces), p=odds)](rng, x, z, size), z + 0.6 * size
    other = rng.random()
    if other < 0.25:  # a small plate below, with a line of text
        low = z - size - 0.3
        solids += [
            _plate(BACK, x, 0.85 * size, (low, low + 0.25), 0),
            _plate(WHITE, x, 0.85 * size, (low, low + 0.25), 1),
            _plate(BLACK, x, 0.6 * size, (low + 0.1, low + 0.16), 2),
        ]
    elif other < 0.4 and size < 0.38:
        solids += _mandatory(rng, x, z + 2 * size + 0.04, size)
        top = z + 2.5 * size
    return Shape((0.3, 0.3), [tube(metal, 0.0, 0.0, (0.0, top), radius), *solids])


def _board(rng: np.random.Generator, metal: Material) -> Shape:
    """A direction board: lines of text and an arrow in a frame."""
    half, high = float(rng.uniform(0.6, 1.25)), float(rng.uniform(0.7, 1.5))
    color, ink = ((YELLOW, BLACK), (BLUE, WHITE), (GREEN, WHITE), (WHITE, BLACK))[rng.choice(4)]
    x, low, post = -0.09, float(rng.uniform(2.1, 2.5)), min(0.42, 0.7 * half)
    solids = [tube(metal, 0.0, y, (0.0, low + 0.9 * high), 0.06) for y in (-post, post)]
    top, arrow = low + high, float(rng.choice((-0.7, 0.7))) * half
    solids += [
        _plate(BACK, x, half, (low, top), 0),
        _plate(ink, x, half, (low, top), 1),
        _plate(color, x, half - 0.035, (low + 0.035, top - 0.035), 2),
        _plate(ink, x, 0.035, (low + 0.15, top - 0.3), 3, y=arrow),
        _plate(ink, x, 0.13, (top - 0.32, top - 0.1), 3, taper=0.05, y=arrow),
    ]
    for z in np.arange(low + 0.16, top - 0.22, 0.3).tolist():
        wide = float(rng.uniform(0.25, 0.5)) * half
        text = -math.copysign(0.85 * half - wide, arrow)
        solids.append(_plate(ink, x, wide, (z, z + 0.13), 3, y=text))
    return Shape((0.3, 2 * post + 0.2), solids)


def _plate(
    color: Color,
    x: float,
    half_y: float,
    z: Range,
    layer: int,
    taper: float = 1.0,
    y: float = 0.0,
) -> Solid:
    """A sheet that faces oncoming traffic. Layer 0 is a sign's back; higher layers are in front."""
    front, back = x - 0.01 - 0.006 * layer, x + (0.02 if layer == 0 else 0.012)
    center, half = ((front + back) / 2, y, sum(z) / 2), ((back - front) / 2, half_y)
    material = Material("traffic-sign", color)
    return Solid(material, center, (*half, (z[1] - z[0]) / 2), BOX, taper=(1.0, taper))


def _disc(color: Color, x: float, z: float, radius: float, layer: int) -> Solid:
    """A round sheet, slightly domed."""
    center = (x + 0.006 - 0.007 * layer, 0.0, z)
    return ball(Material("traffic-sign", color), center, (0.02, radius, radius))


def _round(x: float, z: float, size: float, color: Color) -> list[Solid]:
    return [_disc(BACK, x, z, size, 0), _disc(color, x, z, size, 1)]


def _speed_limit(rng: np.random.Generator, x: float, z: float, size: float) -> list[Solid]:
    """A white disc in a red ring, with two figures."""
    wide, tall = 0.17 * size, 0.34 * size
    solids = [*_round(x, z, size, RED), _disc(WHITE, x, z, 0.8 * size, 2)]
    for y in (-1.3 * wide, 1.3 * wide):
        solids.append(_plate(BLACK, x, wide, (z - tall, z + tall), 4, y=y))
    inner = (z - 0.6 * tall, z + 0.6 * tall)
    return [*solids, _plate(WHITE, x, 0.4 * wide, inner, 5, y=-1.3 * wide)]


def _no_entry(rng: np.random.Generator, x: float, z: float, size: float) -> list[Solid]:
    """A white bar on red, or a white disc in a red ring."""
    solids = _round(x, z, size, RED)
    if rng.random() < 0.6:
        return [*solids, _plate(WHITE, x, 0.72 * size, (z - 0.16 * size, z + 0.16 * size), 4)]
    return [*solids, _disc(WHITE, x, z, 0.8 * size, 2)]


def _mandatory(rng: np.random.Generator, x: float, z: float, size: float) -> list[Solid]:
    """A white arrow on a blue disc."""
    tip = 0.32 * size
    return [
        *_round(x, z, size, BLUE),
        _plate(WHITE, x, 0.1 * size, (z - 0.55 * size, z + 0.2 * size), 4),
        _plate(WHITE, x, tip, (z + 0.12 * size, z + 0.6 * size), 4, taper=0.05),
    ]


def _warning(rng: np.random.Generator, x: float, z: float, size: float) -> list[Solid]:
    """A white triangle in a red one, with a black mark."""
    size, low = 1.12 * size, z - 0.85 * size
    return [
        _plate(BACK, x, size, (low, low + 1.73 * size), 0, 0.05),
        _plate(RED, x, size, (low, low + 1.73 * size), 1, 0.05),
        _plate(WHITE, x, 0.70 * size, (low + 0.16 * size, low + 1.40 * size), 2, 0.04),
        _plate(BLACK, x, 0.09 * size, (low + 0.30 * size, low + 0.95 * size), 3),
    ]


def _give_way(rng: np.random.Generator, x: float, z: float, size: float) -> list[Solid]:
    """A white triangle in a red one, upside down."""
    size, top, wide = 1.12 * size, z + 0.85 * size, 20.0
    return [
        _plate(BACK, x, size / wide, (top - 1.73 * size, top), 0, wide),
        _plate(RED, x, size / wide, (top - 1.73 * size, top), 1, wide),
        _plate(WHITE, x, 0.70 * size / wide, (top - 1.40 * size, top - 0.16 * size), 2, wide),
    ]


def _stop(rng: np.random.Generator, x: float, z: float, size: float) -> list[Solid]:
    """A red octagon with a white word across."""
    corner = math.tan(math.pi / 8)
    edge = corner * size
    return [
        _plate(RED, x, edge, (z - size, z - edge), 1, 1 / corner),
        _plate(RED, x, size, (z - edge, z + edge), 1),
        _plate(RED, x, size, (z + edge, z + size), 1, corner),
        _plate(BACK, x, 0.75 * size, (z - 0.6 * size, z + 0.6 * size), 0),
        _plate(WHITE, x, 0.75 * size, (z - 0.2 * size, z + 0.2 * size), 2),
    ]


def _priority(rng: np.random.Generator, x: float, z: float, size: float) -> list[Solid]:
    """A yellow diamond in a white one: priority road."""
    size = 1.1 * size
    solids = [_plate(BACK, x, 0.45 * size, (z - 0.45 * size, z + 0.45 * size), 0)]
    for layer, color, half in ((1, WHITE, size), (2, YELLOW, 0.72 * size)):
        solids.append(_plate(color, x, 0.05 * half, (z - half, z), layer, 20.0))
        solids.append(_plate(color, x, half, (z, z + half), layer, 0.05))
    return solids


def _panel(rng: np.random.Generator, x: float, z: float, size: float) -> list[Solid]:
    """A rectangle: zebra crossing, parking, or a town's name."""
    kind, tall = rng.choice(3), (z - size, z + size)
    if kind == 2:  # a name
        wide, tall = 1.35 * size, (z - 0.6 * size, z + 0.6 * size)
        return [
            _plate(BACK, x, wide, tall, 0),
            _plate(BLACK, x, wide, tall, 1),
            _plate(YELLOW, x, wide - 0.025, (tall[0] + 0.025, tall[1] - 0.025), 2),
            _plate(BLACK, x, 0.7 * wide, (z - 0.1 * size, z + 0.2 * size), 3),
        ]
    solids = [_plate(BACK, x, 0.9 * size, tall, 0), _plate(BLUE, x, 0.9 * size, tall, 1)]
    if kind == 0:  # zebra crossing
        low = z - 0.6 * size
        return [
            *solids,
            _plate(WHITE, x, 0.7 * size, (low, low + 1.2 * size), 2, 0.04),
            _plate(BLACK, x, 0.1 * size, (low + 0.15 * size, low + 0.7 * size), 3),
        ]
    return [  # the letter P
        *solids,
        _plate(WHITE, x, 0.12 * size, (z - 0.65 * size, z + 0.65 * size), 2, y=0.25 * size),
        _plate(WHITE, x, 0.35 * size, (z - 0.1 * size, z + 0.65 * size), 2, y=-0.02 * size),
        _plate(BLUE, x, 0.14 * size, (z + 0.12 * size, z + 0.43 * size), 3, y=-0.02 * size),
    ]
