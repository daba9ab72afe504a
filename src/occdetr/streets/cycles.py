"""Bicycles and motorcycles, parked or ridden; all parts of a ridden one have the rider's class."""

from __future__ import annotations

import numpy as np

from occdetr.streets.parts import (
    RED_LIGHT,
    TYRE,
    WHITE_LIGHT,
    across,
    ball,
    beam,
    make_trim,
    paint,
    slab,
    wheel,
)
from occdetr.streets.people import CLOTHES, Pose, rider
from occdetr.streets.solids import METAL, PAINT, Material, Shape, Solid, box

FRAMES = (
    (0.60, 0.08, 0.08),
    (0.08, 0.20, 0.50),
    (0.06, 0.06, 0.07),
    (0.80, 0.80, 0.78),
    (0.10, 0.40, 0.25),
    (0.85, 0.55, 0.08),
    (0.40, 0.62, 0.70),
)
HELMETS = ((0.90, 0.90, 0.88), (0.08, 0.08, 0.09), (0.70, 0.10, 0.10), (0.15, 0.30, 0.60))


def bicycle(rng: np.random.Generator) -> Shape:
    """A parked bicycle: wheels as rings, a frame of tubes, saddle, handlebar."""
    return Shape((1.8, 0.6), _bicycle("bicycle", rng))


def motorcycle(rng: np.random.Generator) -> Shape:
    """A parked motorcycle or scooter."""
    make = _motorbike if rng.random() < 0.6 else _scooter
    return Shape((2.2, 0.8), make("motorcycle", rng))


def bicyclist(rng: np.random.Generator) -> Shape:
    """A person who rides a bicycle, leaning forward, one foot up."""
    crank = float(rng.uniform(0.0, 2 * np.pi))
    across_x, up = 0.17 * float(np.cos(crank)), 0.17 * float(np.sin(crank))
    pose = Pose(
        hips=(-0.20, 0.97),
        shoulders=(float(rng.uniform(0.05, 0.16)), 1.46),
        hands=(0.34, 0.26, 1.06),
        feet=((-0.06 + across_x, 0.12, 0.30 + up), (-0.06 - across_x, -0.12, 0.30 - up)),
    )
    helmet = paint("bicyclist", HELMETS, rng) if rng.random() < 0.5 else None
    return Shape(
        (1.8, 0.65), _bicycle("bicyclist", rng, True) + rider("bicyclist", rng, pose, helmet)
    )


def motorcyclist(rng: np.random.Generator) -> Shape:
    """A rider in a helmet on a motorcycle or scooter."""
    bike = rng.random() < 0.65
    if bike:
        solids = _motorbike("motorcyclist", rng, True)
        foot, shoulders = (-0.12, 0.24, 0.32), (float(rng.uniform(-0.14, 0.0)), 1.36)
    else:
        solids = _scooter("motorcyclist", rng, True)
        foot, shoulders = (0.16, 0.14, 0.36), (-0.26, 1.38)
    pose = Pose(
        hips=(-0.32, 0.90),
        shoulders=shoulders,
        hands=(0.36, 0.32, 1.02),
        feet=(foot, (foot[0], -foot[1], foot[2])),
    )
    helmet = paint("motorcyclist", HELMETS + FRAMES, rng, PAINT)
    solids += rider("motorcyclist", rng, pose, helmet, covered=True)
    return Shape((2.2, 0.85), solids)


def _bicycle(name: str, rng: np.random.Generator, ridden: bool = False) -> list[Solid]:
    frame, metal = paint(name, FRAMES, rng, PAINT), Material(name, (0.55, 0.56, 0.58), METAL)
    tyre = Material(name, TYRE)
    low = rng.random() < 0.4  # a step-through frame
    crank, seat, head = (-0.06, 0.0, 0.30), (-0.20, 0.0, 0.84), (0.37, 0.0, 0.86)
    rear, front = (-0.52, 0.0, 0.34), (0.54, 0.0, 0.34)
    top = (-0.1, 0.0, 0.48) if low else (-0.18, 0.0, 0.78)
    solids = [
        wheel(tyre, rear, 0.34, 0.022, 0.9),
        wheel(tyre, front, 0.34, 0.022, 0.9),
        wheel(metal, crank, 0.10, 0.025, 0.6),
        beam(frame, crank, seat, 0.02),
        beam(frame, crank, (0.39, 0.0, 0.72), 0.022),
        beam(frame, top, (0.38, 0.0, 0.78), 0.02),
        beam(frame, rear, (-0.17, 0.0, 0.72), 0.02),
        across(frame, (-0.52, -0.06), 0.025, (0.30, 0.34)),
        beam(frame, front, head, 0.022),
        beam(metal, head, (0.34, 0.0, 1.04), 0.02),
        across(tyre, (0.31, 0.35), 0.29, (1.02, 1.06)),
        slab(tyre, (-0.28, -0.06), (-0.36, -0.04), 0.07, (0.86, 0.92)),
    ]
    if rng.random() < 0.3:  # a basket
        solids.append(slab(tyre, (0.42, 0.66), (0.38, 0.70), 0.16, (0.78, 1.0)))
    if ridden:
        return solids
    solids.append(ball(Material(name, WHITE_LIGHT), (0.43, 0.0, 0.88), (0.04, 0.035, 0.035)))
    solids.append(across(tyre, (-0.10, -0.02), 0.15, (0.285, 0.315)))  # pedals
    solids += [wheel(metal, hub, 0.045, 0.04) for hub in (rear, front)]
    if rng.random() < 0.5:  # a carrier
        solids.append(across(metal, (-0.72, -0.24), 0.06, (0.70, 0.73)))
        solids.append(across(Material(name, RED_LIGHT), (-0.75, -0.71), 0.03, (0.64, 0.72)))
    return solids


def _motorbike(name: str, rng: np.random.Generator, ridden: bool = False) -> list[Solid]:
    trim = make_trim(name, rng)
    body = paint(name, FRAMES, rng, PAINT)
    engine = Material(name, (0.15, 0.15, 0.16), METAL)
    rear, front = (-0.70, 0.0, 0.31), (0.72, 0.0, 0.31)
    tyre = float(rng.uniform(0.055, 0.085))
    solids = [
        wheel(trim.tyre, rear, 0.31, tyre + 0.015, 0.66),
        wheel(trim.tyre, front, 0.31, tyre, 0.66),
        wheel(trim.rim, rear, 0.15, 0.09),
        wheel(trim.rim, front, 0.15, 0.08),
        across(trim.plastic, (-0.72, 0.0), 0.11, (0.30, 0.38)),
        slab(engine, (-0.28, 0.26), (-0.22, 0.34), 0.16, (0.22, 0.60), 0.75),
        slab(body, (-0.35, 0.36), (-0.42, 0.42), 0.10, (0.58, 0.76)),
        ball(body, (0.12, 0.0, 0.83), (0.33, 0.17, 0.15)),
        slab(trim.plastic, (-0.78, -0.06), (-0.80, -0.10), 0.14, (0.74, 0.83)),
        slab(body, (-0.82, -0.30), (-0.98, -0.30), 0.11, (0.62, 0.76)),
        slab(trim.rim, (0.65, 0.73), (0.39, 0.46), 0.10, (0.31, 0.98)),
        slab(body, (0.52, 0.92), (0.60, 0.82), 0.08, (0.62, 0.67)),
        ball(trim.white_light, (0.52, 0.0, 0.88), (0.09, 0.10, 0.10)),
        across(trim.plastic, (0.34, 0.38), 0.37, (1.0, 1.04)),
        box(trim.rim, (-0.85, 0.05), (-0.24, -0.15), (0.32, 0.42)),
        across(trim.red_light, (-1.0, -0.94), 0.07, (0.68, 0.76)),
        slab(trim.plate, (-1.02, -1.0), (-0.98, -0.96), 0.09, (0.45, 0.62)),
    ]
    if rng.random() < 0.5:
        solids.append(slab(trim.glass, (0.50, 0.54), (0.36, 0.39), 0.17, (0.98, 1.25), 0.7))
    for side in () if ridden else (-1, 1):  # mirrors
        solids.append(ball(trim.plastic, (0.36, 0.30 * side, 1.16), (0.025, 0.07, 0.045)))
    return solids


def _scooter(name: str, rng: np.random.Generator, ridden: bool = False) -> list[Solid]:
    trim = make_trim(name, rng)
    body = paint(name, (*FRAMES, (0.85, 0.82, 0.70)), rng, PAINT)
    rear, front = (-0.62, 0.0, 0.24), (0.64, 0.0, 0.24)
    solids = [
        wheel(trim.tyre, rear, 0.24, 0.06),
        wheel(trim.tyre, front, 0.24, 0.055),
        wheel(trim.rim, rear, 0.14, 0.068),
        wheel(trim.rim, front, 0.14, 0.063),
        slab(body, (-0.72, -0.12), (-0.90, -0.10), 0.18, (0.32, 0.74)),
        slab(trim.plastic, (-0.86, -0.10), (-0.84, -0.14), 0.15, (0.74, 0.84)),
        slab(trim.plastic, (-0.2, 0.36), (-0.2, 0.40), 0.17, (0.22, 0.32)),
        slab(body, (0.38, 0.50), (0.30, 0.38), 0.21, (0.26, 0.92), 0.75),
        slab(body, (0.46, 0.84), (0.50, 0.72), 0.09, (0.46, 0.54)),
        slab(trim.plastic, (0.60, 0.68), (0.32, 0.40), 0.05, (0.24, 0.90)),
        slab(body, (0.26, 0.46), (0.28, 0.40), 0.13, (0.90, 1.06)),
        ball(trim.white_light, (0.43, 0.0, 0.97), (0.05, 0.08, 0.06)),
        across(trim.plastic, (0.31, 0.35), 0.34, (1.0, 1.04)),
        across(trim.red_light, (-0.92, -0.86), 0.08, (0.62, 0.70)),
        slab(trim.plate, (-0.88, -0.86), (-0.91, -0.89), 0.09, (0.40, 0.56)),
        box(trim.rim, (-0.80, -0.30), (-0.20, -0.10), (0.24, 0.34)),
    ]
    if rng.random() < 0.35:  # a case behind the seat
        case = paint(name, CLOTHES, rng)
        solids.append(slab(case, (-1.05, -0.74), (-1.02, -0.78), 0.19, (0.84, 1.14)))
    for side in () if ridden else (-1, 1):
        solids.append(ball(trim.plastic, (0.34, 0.28 * side, 1.15), (0.025, 0.06, 0.045)))
    return solids
