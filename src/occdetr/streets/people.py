"""People on foot, and the riders of two-wheelers."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from occdetr.streets.parts import Point, ball, beam, paint, slab, tube
from occdetr.streets.solids import CYLINDER, GLASS, Color, Material, Shape, Solid, box

CLOTHES: tuple[Color, ...] = (
    (0.62, 0.10, 0.10),
    (0.12, 0.20, 0.50),
    (0.82, 0.82, 0.78),
    (0.85, 0.64, 0.12),
    (0.10, 0.10, 0.11),
    (0.32, 0.33, 0.35),
    (0.46, 0.16, 0.42),
    (0.08, 0.45, 0.45),
    (0.20, 0.36, 0.16),
    (0.80, 0.42, 0.36),
    (0.42, 0.30, 0.20),
)
TROUSERS = (
    (0.08, 0.09, 0.14),
    (0.14, 0.20, 0.34),
    (0.22, 0.22, 0.23),
    (0.42, 0.36, 0.27),
    (0.06, 0.06, 0.06),
    (0.28, 0.34, 0.45),
)
SKINS = ((0.80, 0.60, 0.48), (0.72, 0.50, 0.38), (0.50, 0.33, 0.23), (0.32, 0.20, 0.14))
HAIR = ((0.08, 0.06, 0.05), (0.22, 0.14, 0.08), (0.55, 0.40, 0.20), (0.55, 0.54, 0.52))
SHOES = ((0.06, 0.06, 0.06), (0.25, 0.15, 0.09), (0.80, 0.80, 0.78))


class Pose(NamedTuple):
    """A rider's joints in metres: (x, z) in the plane of symmetry, (x, y, z) of the left hand and
    of both feet, left first; the right hand is the left one mirrored."""

    hips: tuple[float, float]
    shoulders: tuple[float, float]
    hands: Point
    feet: tuple[Point, Point]


def person(rng: np.random.Generator) -> Shape:
    """An adult or a child, standing or walking, in trousers, shorts, a skirt or a coat."""
    tall = float(rng.uniform(1.55, 1.92) if rng.random() < 0.85 else rng.uniform(1.0, 1.4))
    stride = float(rng.uniform(0.06, 0.17) * tall) if rng.random() < 0.65 else 0.0
    skin, top = paint("person", SKINS, rng), paint("person", CLOTHES, rng)
    legs = ("trousers", "shorts", "skirt", "coat")[rng.choice(4, p=(0.6, 0.14, 0.14, 0.12))]
    lower = top if legs == "coat" else paint("person", TROUSERS, rng)
    if legs == "skirt":
        lower = paint("person", CLOTHES, rng)
    stout, hips, neck = float(rng.uniform(0.9, 1.2)), 0.5 * tall, 0.83 * tall
    half = (0.075 * tall * stout, 0.105 * tall * min(stout, 1.1))

    solids = _legs(rng, tall, stride, lower, lower if legs == "trousers" else skin)
    solids += [
        _trunk(top, (0.9 * half[0], 0.9 * half[1]), (0.94 * hips, neck - 0.02 * tall), 1.25),
        ball(top, (0.0, 0.0, neck - 0.03 * tall), (1.02 * half[0], 1.18 * half[1], 0.045 * tall)),
        *_head(rng, skin, (0.0, 0.0, 0.93 * tall), tall),
        tube(skin, 0.0, 0.0, (neck - 0.02 * tall, 0.88 * tall), 0.032 * tall),
    ]
    sleeves = skin if legs == "shorts" else top
    for side in (-1, 1):
        shoulder = (0.0, side * 1.08 * half[1], neck - 0.03 * tall)
        elbow = (-0.01 - 0.5 * side * stride, side * 1.22 * half[1], 0.64 * tall)
        hand = (0.03 * tall - 0.9 * side * stride, side * 1.3 * half[1], 0.49 * tall)
        solids += [
            beam(top, elbow, shoulder, 0.026 * tall, 0.031 * tall),
            beam(sleeves, hand, elbow, 0.022 * tall, 0.026 * tall),
            ball(skin, hand, (0.027 * tall, 0.022 * tall, 0.034 * tall)),
        ]
    if legs in ("skirt", "coat"):
        low = tall * float(rng.uniform(0.22, 0.33))
        solids.append(_trunk(lower, (1.35 * half[0], 1.18 * half[1]), (low, 1.08 * hips), 0.74))
    solids += _luggage(rng, tall, half)
    return Shape((2 * stride + 0.75, 0.85), solids)


def _legs(
    rng: np.random.Generator, tall: float, stride: float, thigh: Material, shin: Material
) -> list[Solid]:
    """Legs bent at the knees, and shoes; the left one is ahead."""
    shoe, solids = paint("person", SHOES, rng), []
    for side in (-1, 1):
        y = side * 0.052 * tall
        hip, foot = (0.0, y, 0.5 * tall), (side * stride, y, 0.05 * tall)
        knee = (0.5 * side * stride + 0.35 * stride, y, 0.275 * tall)
        solids += [
            beam(thigh, knee, hip, 0.036 * tall, 0.048 * tall),
            beam(shin, foot, knee, 0.027 * tall, 0.036 * tall),
            slab(
                shoe,
                (foot[0] - 0.05 * tall, foot[0] + 0.10 * tall),
                (foot[0] - 0.045 * tall, foot[0] + 0.04 * tall),
                0.03 * tall,
                (0.0, 0.055 * tall),
                y=y,
            ),
        ]
    return solids


def _trunk(
    material: Material, half: tuple[float, float], z: tuple[float, float], top: float
) -> Solid:
    """An upright elliptic tube; its top is ``top`` times as wide as its bottom."""
    center, height = (0.0, 0.0, sum(z) / 2), (z[1] - z[0]) / 2
    return Solid(material, center, (*half, height), CYLINDER, taper=(top, top))


def _head(rng: np.random.Generator, skin: Material, center: Point, tall: float) -> list[Solid]:
    """A head with short or long hair, or a hat."""
    x, y, z = center
    name, size = skin.class_name, 0.062 * max(tall, 1.35)  # children have large heads
    hair = paint(name, HAIR, rng)
    solids = [
        ball(skin, center, (size, 0.8 * size, 1.12 * size)),
        ball(hair, (x - 0.2 * size, y, z + 0.25 * size), (size, 0.9 * size, size)),
    ]
    style = rng.random()
    if style < 0.35:
        long = (0.35 * size, 0.75 * size, 1.3 * size)
        solids.append(ball(hair, (x - 0.75 * size, y, z - 0.7 * size), long))
    elif style < 0.5:
        hat, brim = paint(name, CLOTHES, rng), (z + 0.5 * size, z + 1.35 * size)
        solids.append(tube(hat, x, y, brim, 1.08 * size, 0.8))
    return solids


def _luggage(rng: np.random.Generator, tall: float, half: tuple[float, float]) -> list[Solid]:
    """Sometimes a backpack or a bag."""
    kind, material = rng.random(), paint("person", CLOTHES, rng)
    if kind < 0.18:
        x = (-2.3 * half[0], -0.8 * half[0])
        return [slab(material, x, (x[0] + 0.05, x[1]), 0.8 * half[1], (0.55 * tall, 0.8 * tall))]
    if kind < 0.36:
        y = (1.35 * half[1], 1.35 * half[1] + 0.12)
        return [box(material, (-0.17, 0.17), y, (0.28 * tall, 0.45 * tall))]
    return []


def rider(
    name: str,
    rng: np.random.Generator,
    pose: Pose,
    helmet: Material | None,
    covered: bool = False,
) -> list[Solid]:
    """A sitting person of class ``name``; ``covered`` means long sleeves and a full helmet."""
    skin, shirt = paint(name, SKINS, rng), paint(name, CLOTHES, rng)
    trousers, shoe = paint(name, TROUSERS, rng), paint(name, SHOES, rng)
    (hip_x, hip_z), (x, z) = pose.hips, pose.shoulders
    bare = not covered and rng.random() < 0.4
    head = (x + 0.10, 0.0, z + 0.23)
    solids = [
        slab(shirt, (hip_x - 0.11, hip_x + 0.11), (x - 0.12, x + 0.10), 0.15, (hip_z, z), 1.3),
        ball(shirt, (x - 0.01, 0.0, z), (0.12, 0.21, 0.08)),
        ball(trousers, (hip_x, 0.0, hip_z), (0.16, 0.18, 0.12)),
        tube(skin, x + 0.05, 0.0, (z, z + 0.14), 0.055),
    ]
    for side, foot in zip((1, -1), pose.feet, strict=True):
        knee = _joint((hip_x, side * 0.10, hip_z), (foot[0], foot[1], foot[2] + 0.05), 0.45, 1.0)
        solids += [
            beam(trousers, knee, (hip_x, side * 0.10, hip_z), 0.062, 0.078),
            beam(skin if bare else trousers, (foot[0], foot[1], foot[2] + 0.05), knee, 0.048, 0.06),
            slab(
                shoe,
                (foot[0] - 0.08, foot[0] + 0.17),
                (foot[0] - 0.07, foot[0] + 0.08),
                0.05,
                (foot[2], foot[2] + 0.09),
                y=foot[1],
            ),
        ]
        shoulder, hand = (
            (x, side * 0.2, z - 0.02),
            (pose.hands[0], side * pose.hands[1], pose.hands[2]),
        )
        elbow = _joint(shoulder, hand, 0.3, -1.0)
        solids += [
            beam(shirt, elbow, shoulder, 0.045, 0.055),
            beam(skin if bare else shirt, hand, elbow, 0.038, 0.045),
        ]
        if not covered:
            solids.append(ball(skin, hand, (0.055, 0.045, 0.045)))
    if helmet is None:
        return solids + _head(rng, skin, head, 1.75)
    if covered:
        visor = Material(name, (0.06, 0.07, 0.08), GLASS)
        return [
            *solids,
            ball(helmet, head, (0.15, 0.125, 0.145)),
            ball(visor, (head[0] + 0.06, 0.0, head[2] + 0.01), (0.105, 0.108, 0.065)),
        ]
    return [
        *solids,
        ball(skin, head, (0.108, 0.086, 0.12)),
        ball(helmet, (head[0] - 0.015, 0.0, head[2] + 0.05), (0.15, 0.11, 0.10)),
    ]


def _joint(start: Point, end: Point, bone: float, ahead: float) -> Point:
    """The joint between two limbs of equal length, bent forwards (1) or backwards (-1)."""
    (x0, y0, z0), (x1, y1, z1) = start, end
    dx, dz = x1 - x0, z1 - z0
    away = math.dist(start, end)
    bend = math.sqrt(max(bone**2 - (away / 2) ** 2, 0.0))
    flat = max(math.hypot(dx, dz), 1e-6)
    # the normal of the line from joint to joint, in the plane of the two-wheeler
    return (
        (x0 + x1) / 2 - ahead * bend * dz / flat,
        (y0 + y1) / 2,
        (z0 + z1) / 2 + ahead * bend * dx / flat,
    )
