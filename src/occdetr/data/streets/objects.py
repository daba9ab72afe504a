"""Shapes of what moves or stands on a street, each a list of boxes in the object's own frame.

A shape function takes the random generator and the direction the object will face, and returns a
``Shape``: the footprint that must be free and the parts to paint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from occdetr.data.streets.world import SIGN, Material, Part

PAINTS = (
    (0.75, 0.76, 0.78),
    (0.88, 0.88, 0.88),
    (0.10, 0.10, 0.12),
    (0.35, 0.36, 0.38),
    (0.55, 0.08, 0.08),
    (0.08, 0.16, 0.45),
    (0.10, 0.30, 0.20),
    (0.62, 0.55, 0.40),
)
CLOTHES = (
    (0.70, 0.12, 0.12),
    (0.15, 0.25, 0.60),
    (0.85, 0.85, 0.80),
    (0.90, 0.70, 0.15),
    (0.15, 0.15, 0.16),
    (0.55, 0.20, 0.50),
    (0.10, 0.55, 0.55),
)
CARAVANS = ((0.85, 0.83, 0.76), (0.80, 0.80, 0.70))
SKIN = (0.80, 0.60, 0.48)
GLASS = (0.10, 0.14, 0.18)
TYRE = (0.06, 0.06, 0.06)
RED_LIGHT = (0.85, 0.08, 0.05)
WHITE_LIGHT = (0.95, 0.95, 0.88)

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Shape:
    """Footprint (length, width) in metres and the parts, painted in order."""

    size: tuple[float, float]
    parts: list[Part]


ShapeFunction = Callable[[np.random.Generator, float], Shape]


def _pick(colors: tuple[Color, ...], rng: np.random.Generator) -> Color:
    red, green, blue = np.array(colors[rng.integers(len(colors))]) * rng.uniform(0.85, 1.12)
    return float(red), float(green), float(blue)


def _wheels(material: Material, length: float, width: float, radius: float = 0.32) -> list[Part]:
    half = width / 2
    return [
        Part(material, (x - radius, x + radius), y, (0.0, 2 * radius))
        for x in (-0.32 * length, 0.32 * length)
        for y in ((-half, -half + 0.25), (half - 0.25, half))
    ]


def _lights(name: str, length: float, width: float, z: float) -> list[Part]:
    half, end = width / 2, length / 2
    red, white = (Material(name, color) for color in (RED_LIGHT, WHITE_LIGHT))
    return [
        Part(material, x, y, (z, z + 0.2))
        for material, x in ((red, (-end, -end + 0.22)), (white, (end - 0.22, end)))
        for y in ((-half, -half + 0.45), (half - 0.45, half))
    ]


def car(rng: np.random.Generator, yaw: float) -> Shape:
    """A hatchback, saloon, estate or van: body, glazed cabin, roof, wheels and lights."""
    length, width = rng.uniform(3.6, 4.9), rng.uniform(1.65, 1.9)
    height, half, end = rng.uniform(1.4, 1.6), width / 2, length / 2
    van = rng.random() < 0.15
    height += 0.4 * van
    front, back = end - rng.uniform(0.9, 1.3), -end + (0.1 if van else rng.uniform(0.1, 0.9))
    body = Material("car", _pick(PAINTS, rng), yaw=yaw)
    glass, tyre = Material("car", GLASS), Material("car", TYRE)
    inner = (-half + 0.1, half - 0.1)
    parts = [
        Part(body, (-end, end), (-half, half), (0.2, 0.9)),
        Part(glass, (back, front), inner, (0.9, height - 0.2)),
        Part(body, (back + 0.25, front - 0.45), inner, (height - 0.2, height)),
    ]
    if van:  # no windows behind the driver
        parts.append(Part(body, (back, front - 1.2), inner, (0.9, height)))
    parts += _wheels(tyre, length, width) + _lights("car", length, width, 0.6)
    return Shape((length, width), parts)


def truck(rng: np.random.Generator, yaw: float) -> Shape:
    """A lorry: cab with windscreen, a gap, and a high box or a low flatbed behind it."""
    length, width = rng.uniform(6.0, 9.5), rng.uniform(2.2, 2.5)
    half, end, height = width / 2, length / 2, rng.uniform(2.8, 3.5)
    cab = Material("truck", _pick(CLOTHES, rng), yaw=yaw)
    load = Material("truck", _pick(((0.80, 0.80, 0.77), (0.60, 0.62, 0.65)), rng), yaw=yaw)
    glass, tyre = Material("truck", GLASS), Material("truck", TYRE)
    top = height if rng.random() < 0.75 else 1.7
    parts = [
        Part(tyre, (-end, end), (-half + 0.3, half - 0.3), (0.4, 0.9)),
        Part(cab, (end - 1.9, end), (-half, half), (0.4, 2.5)),
        Part(glass, (end - 0.25, end), (-half + 0.1, half - 0.1), (1.5, 2.2)),
        Part(glass, (end - 1.1, end - 0.3), (-half, half), (1.5, 2.2)),
        Part(load, (-end, end - 2.2), (-half, half), (0.9, top)),
    ]
    parts += _wheels(tyre, length, width, 0.5) + _lights("truck", length, width, 0.7)
    return Shape((length, width), parts)


def other_vehicle(rng: np.random.Generator, yaw: float) -> Shape:
    """A bus with a band of windows along it, or a caravan."""
    bus = rng.random() < 0.65
    length = rng.uniform(8.5, 11.5) if bus else rng.uniform(3.8, 5.0)
    width, height = rng.uniform(2.2, 2.5), 3.0 if bus else 2.5
    half, end = width / 2, length / 2
    paints = ((0.88, 0.68, 0.10), (0.75, 0.12, 0.10), (0.15, 0.45, 0.65), (0.30, 0.55, 0.25))
    body = Material("other-vehicle", _pick(paints if bus else CARAVANS, rng), yaw=yaw)
    glass = Material("other-vehicle", GLASS)
    tyre = Material("other-vehicle", TYRE)
    parts = [
        Part(body, (-end, end), (-half, half), (0.3, height)),
        Part(glass, (-end if bus else -0.8, end if bus else 0.8), (-half, half), (1.4, 2.2)),
    ]
    parts += [
        Part(body, (x, x + 0.25), (-half, half), (1.4, 2.2)) for x in np.arange(-end, end, 1.6)
    ]
    lights = _lights("other-vehicle", length, width, 0.6)
    return Shape((length, width), parts + _wheels(tyre, length, width, 0.45) + lights)


def bicycle(rng: np.random.Generator, yaw: float) -> Shape:
    """Two wheels, a frame, a saddle and a handlebar."""
    return Shape((1.8, 0.5), _two_wheeler("bicycle", rng, yaw, slim=True))


def motorcycle(rng: np.random.Generator, yaw: float) -> Shape:
    """Broader and fuller than a bicycle, with a tank and a seat."""
    return Shape((2.2, 0.8), _two_wheeler("motorcycle", rng, yaw, slim=False))


def _two_wheeler(name: str, rng: np.random.Generator, yaw: float, slim: bool) -> list[Part]:
    paint = Material(name, _pick(CLOTHES if slim else PAINTS[2:], rng), yaw=yaw)
    tyre = Material(name, TYRE)
    end, half = (0.9, 0.1) if slim else (1.1, 0.3)
    parts = [
        Part(tyre, (-end, -end + 0.6), (-0.1, 0.1), (0.0, 0.6)),
        Part(tyre, (end - 0.6, end), (-0.1, 0.1), (0.0, 0.6)),
        Part(paint, (-0.4, 0.4), (-half, half), (0.4, 0.7 if slim else 0.9)),
        Part(paint, (end - 0.6, end - 0.4), (-0.3, 0.3), (0.9, 1.1)),
        Part(paint, (end - 0.6, end - 0.35), (-0.1, 0.1), (0.6, 1.0)),
        Part(tyre, (-0.5, -0.1), (-half, half), (0.8, 1.0)),
    ]
    return parts if slim else [*parts, Part(paint, (-0.8, 0.6), (-0.25, 0.25), (0.4, 0.8))]


def person(rng: np.random.Generator, yaw: float) -> Shape:
    """Two legs, a torso with arms, a head; adults and children."""
    tall = rng.uniform(1.55, 1.9) if rng.random() < 0.85 else rng.uniform(1.0, 1.4)
    return Shape((0.5, 0.6), _upright("person", rng, yaw, 0.0, tall, 0.0))


def _upright(
    name: str,
    rng: np.random.Generator,
    yaw: float,
    legs_from: float,
    tall: float,
    x: float,
) -> list[Part]:
    shirt = Material(name, _pick(CLOTHES, rng), yaw=yaw)
    trousers = Material(name, (0.16, 0.17, 0.24))
    skin = Material(name, SKIN)
    waist, neck = legs_from + 0.45 * (tall - legs_from), tall - 0.25
    stride = rng.uniform(0.0, 0.2)
    return [
        Part(trousers, (x - 0.1 + stride, x + 0.1 + stride), (0.02, 0.22), (legs_from, waist)),
        Part(trousers, (x - 0.1 - stride, x + 0.1 - stride), (-0.22, -0.02), (legs_from, waist)),
        Part(shirt, (x - 0.15, x + 0.15), (-0.3, 0.3), (waist, neck)),
        Part(skin, (x - 0.12, x + 0.12), (-0.12, 0.12), (neck, tall)),
    ]


def bicyclist(rng: np.random.Generator, yaw: float) -> Shape:
    """A person riding a bicycle; the bicycle counts as part of the bicyclist."""
    parts = _two_wheeler("bicyclist", rng, yaw, slim=True)
    return Shape((1.8, 0.6), parts + _upright("bicyclist", rng, yaw, 0.4, 1.8, -0.2))


def motorcyclist(rng: np.random.Generator, yaw: float) -> Shape:
    """A rider with a helmet on a motorcycle, which counts as part of the motorcyclist."""
    parts = _two_wheeler("motorcyclist", rng, yaw, slim=False)
    parts += _upright("motorcyclist", rng, yaw, 0.5, 1.6, -0.2)
    helmet = Material("motorcyclist", _pick(PAINTS, rng), yaw=yaw)
    return Shape((2.2, 0.8), [*parts, Part(helmet, (-0.35, -0.05), (-0.15, 0.15), (1.35, 1.65))])


def lamp(rng: np.random.Generator, yaw: float) -> Shape:
    """A street lamp, its arm to the left (over the road if it stands on the right)."""
    metal = Material("pole", (0.42, 0.44, 0.45))
    high, arm = rng.uniform(4.0, 8.0), rng.uniform(0.0, 1.8)
    return Shape(
        (0.3, 0.3),
        [
            Part(metal, (-0.1, 0.1), (-0.1, 0.1), (0.0, high)),
            Part(metal, (-0.1, 0.1), (-0.1, arm), (high - 0.2, high)),
        ],
    )


def traffic_sign(rng: np.random.Generator, yaw: float) -> Shape:
    """A plate on a pole; the plate looks backwards, at the drivers who come."""
    metal = Material("pole", (0.52, 0.53, 0.54))
    colors = ((0.80, 0.08, 0.08), (0.08, 0.22, 0.65), (0.92, 0.76, 0.10), (0.90, 0.90, 0.90))
    plate = Material("traffic-sign", colors[rng.integers(len(colors))], SIGN, yaw)
    low, half = rng.uniform(1.8, 2.4), rng.uniform(0.3, 0.5)
    high = low + rng.uniform(0.6, 1.0)
    return Shape(
        (0.3, 0.3),
        [
            Part(metal, (-0.1, 0.1), (-0.1, 0.1), (0.0, low)),
            Part(plate, (-0.12, 0.1), (-half, half), (low, high)),
        ],
    )


def traffic_light(rng: np.random.Generator, yaw: float) -> Shape:
    """A mast with a dark housing; all of it is labelled pole, as SemanticKITTI does."""
    metal = Material("pole", (0.30, 0.31, 0.32))
    red = Material("pole", RED_LIGHT)
    return Shape(
        (0.3, 0.3),
        [
            Part(metal, (-0.1, 0.1), (-0.1, 0.1), (0.0, 2.2)),
            Part(metal, (-0.2, 0.2), (-0.2, 0.2), (2.2, 3.2)),
            Part(red, (-0.2, -0.1), (-0.1, 0.1), (2.9, 3.1)),
        ],
    )
