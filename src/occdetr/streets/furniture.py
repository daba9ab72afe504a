"""Street furniture besides signs: lamps, traffic lights, bollards, all of class pole."""

from __future__ import annotations

import numpy as np

from occdetr.streets.parts import ball, beam, paint, tube
from occdetr.streets.solids import (
    BARK,
    METAL,
    Color,
    Material,
    Shape,
    Solid,
    box,
)

POLES: tuple[Color, ...] = ((0.42, 0.44, 0.45), (0.55, 0.56, 0.57), (0.22, 0.24, 0.25))
PAINTED_POLES = (*POLES, (0.10, 0.20, 0.15), (0.16, 0.18, 0.26))
WOOD = ((0.34, 0.27, 0.20), (0.42, 0.36, 0.30))
RED, WHITE = (0.72, 0.05, 0.05), (0.92, 0.92, 0.90)


def lamp(rng: np.random.Generator) -> Shape:
    """A street lamp: a mast with an arm to the left, a lantern on a post, or a wooden mast."""
    metal = paint("pole", PAINTED_POLES, rng, METAL)
    glow = Material("pole", (0.90, 0.89, 0.82))
    kind = rng.random()
    if kind < 0.25:
        return Shape((0.4, 0.4), _lantern(metal, glow, float(rng.uniform(3.2, 4.5))))
    high, arm = float(rng.uniform(5.0, 8.5)), float(rng.uniform(0.7, 2.0))
    radius = float(rng.uniform(0.075, 0.1))
    if kind < 0.4:
        metal = paint("pole", WOOD, rng, BARK)
        radius = float(rng.uniform(0.1, 0.13))
    head = high + 0.12 * arm
    return Shape(
        (0.4, 0.4),
        [
            tube(metal, 0.0, 0.0, (0.0, high), radius, 0.62),
            tube(metal, 0.0, 0.0, (0.0, 0.9), radius + 0.03),
            beam(metal, (0.0, 0.0, high - 0.1), (0.0, arm, head), 0.05),
            box(metal, (-0.14, 0.14), (arm - 0.1, arm + 0.6), (head - 0.02, head + 0.1)),
            box(glow, (-0.11, 0.11), (arm, arm + 0.55), (head - 0.05, head)),
        ],
    )


def _lantern(metal: Material, glow: Material, high: float) -> list[Solid]:
    return [
        tube(metal, 0.0, 0.0, (0.0, high), 0.07, 0.75),
        tube(metal, 0.0, 0.0, (0.0, 0.7), 0.11),
        tube(glow, 0.0, 0.0, (high, high + 0.42), 0.12, 1.5),
        tube(metal, 0.0, 0.0, (high + 0.42, high + 0.56), 0.24, 0.3),
    ]


def bollard(rng: np.random.Generator) -> Shape:
    """A short post with a bright band, round or with a dome."""
    high, radius = float(rng.uniform(0.75, 1.1)), float(rng.uniform(0.055, 0.1))
    post = paint("pole", (*PAINTED_POLES, WHITE, RED), rng, METAL)
    band = Material("pole", RED if post.color[0] > 0.8 else WHITE)
    return Shape(
        (0.25, 0.25),
        [
            tube(post, 0.0, 0.0, (0.0, high), radius),
            tube(band, 0.0, 0.0, (high - 0.25, high - 0.12), radius + 0.006),
            ball(post, (0.0, 0.0, high), (radius, radius, 0.5 * radius)),
        ],
    )


def traffic_light(rng: np.random.Generator) -> Shape:
    """A mast with a signal that faces oncoming traffic, sometimes a second one over the road."""
    metal = paint("pole", POLES, rng, METAL)
    low, red = float(rng.uniform(2.2, 2.5)), bool(rng.random() < 0.5)
    solids = [
        tube(metal, 0.0, 0.0, (0.0, low + 1.05), 0.075),
        tube(metal, 0.0, 0.0, (0.0, 0.6), 0.1),
        *_signal(-0.2, 0.0, low, red),
    ]
    if rng.random() < 0.4:  # an arm over the road
        arm, high = float(rng.uniform(2.5, 4.0)), low + 3.2
        solids += [
            tube(metal, 0.0, 0.0, (1.0, high), 0.09, 0.8),
            beam(metal, (0.0, 0.0, high - 0.15), (0.0, arm, high - 0.1), 0.06),
            *_signal(-0.2, arm - 0.2, high - 0.7, red),
        ]
    elif rng.random() < 0.5:  # a signal for pedestrians
        solids.append(
            box(Material("pole", (0.07, 0.08, 0.08)), (-0.1, 0.1), (0.08, 0.33), (2.1, 2.65))
        )
        solids.append(ball(Material("pole", RED), (0.0, 0.2, 2.5), (0.13, 0.08, 0.08)))
    return Shape((0.45, 0.4), solids)


def _signal(x: float, y: float, low: float, red: bool) -> list[Solid]:
    """A dark housing on a board with a white border, and three lights of which one is on."""
    house, edge = Material("pole", (0.07, 0.08, 0.08)), Material("pole", WHITE)
    lit = ((0.95, 0.10, 0.06), (0.95, 0.62, 0.08), (0.10, 0.85, 0.45))
    dark = ((0.20, 0.04, 0.03), (0.20, 0.13, 0.03), (0.03, 0.16, 0.09))
    on = 0 if red else 2
    solids = [
        box(edge, (x + 0.10, x + 0.13), (y - 0.27, y + 0.27), (low - 0.1, low + 1.0)),
        box(house, (x + 0.08, x + 0.12), (y - 0.24, y + 0.24), (low - 0.07, low + 0.97)),
        box(house, (x - 0.08, x + 0.2), (y - 0.15, y + 0.15), (low, low + 0.9)),
    ]
    for number in range(3):
        z = low + 0.75 - 0.3 * number
        lens = Material("pole", (lit if number == on else dark)[number])
        solids.append(ball(lens, (x - 0.08, y, z), (0.04, 0.105, 0.105)))
        solids.append(box(house, (x - 0.2, x - 0.05), (y - 0.12, y + 0.12), (z + 0.105, z + 0.125)))
    return solids
