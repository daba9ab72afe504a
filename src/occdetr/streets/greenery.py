"""Trees and bushes: trunks, branches, and crowns of leaves."""

from __future__ import annotations

import math

import numpy as np

from occdetr.streets.parts import Point, beam
from occdetr.streets.solids import (
    BARK,
    CYLINDER,
    LEAFY_CONE,
    LEAFY_ELLIPSOID,
    LEAVES,
    Color,
    Material,
    Shape,
    Solid,
)

BARK_COLORS = ((0.30, 0.22, 0.16), (0.42, 0.36, 0.30), (0.36, 0.30, 0.25), (0.26, 0.24, 0.22))
BIRCH = (0.74, 0.72, 0.68)
#: Yellow, orange and copper; other leaves are green.
AUTUMN: tuple[Color, ...] = ((0.46, 0.36, 0.08), (0.48, 0.24, 0.06), (0.30, 0.12, 0.09))


def leaf_material(rng: np.random.Generator) -> Material:
    """The material of one plant's leaves: mostly green, sometimes an autumn colour."""
    if rng.random() < 0.12:
        red, green, blue = np.array(AUTUMN[rng.integers(len(AUTUMN))]) * rng.uniform(0.8, 1.1)
        return Material("vegetation", (float(red), float(green), float(blue)), LEAVES)
    green = rng.uniform(0.22, 0.42)
    red = rng.uniform(0.55, 0.95)
    return Material("vegetation", (green * red, green, green * rng.uniform(0.25, 0.45)), LEAVES)


def tree(rng: np.random.Generator, leaves: Material) -> Shape:
    """A broad-leaved tree: broad, slender, weeping, or with several stems."""
    kinds = (_broad, _slender, _weeping, _many_stemmed)
    return Shape((0.9, 0.9), kinds[rng.choice(4, p=(0.55, 0.18, 0.12, 0.15))](rng, leaves))


def _bark(rng: np.random.Generator) -> Material:
    return Material("trunk", BARK_COLORS[rng.integers(len(BARK_COLORS))], BARK)


def _trunk(bark: Material, thick: float, top: float) -> Solid:
    """An upright trunk from below the ground up to ``top`` metres, narrower at the top."""
    half = 0.5 * top + 0.2
    return Solid(bark, (0, 0, half - 0.4), (thick, thick, half), CYLINDER, taper=(0.5, 1.0))


def _clump(leaves: Material, center: Point, wide: float, half: float, rng: np.random.Generator):
    """Leaves around a branch."""
    reach = (wide, wide * rng.uniform(0.85, 1.15), half)
    yaw = rng.uniform(0, math.pi)
    return Solid(leaves, center, reach, LEAFY_ELLIPSOID, yaw, density=rng.uniform(0.4, 0.6))


def _broad(rng: np.random.Generator, leaves: Material) -> list[Solid]:
    """Branches from one trunk with a clump of leaves at the end of each."""
    bark, thick, clear = _bark(rng), rng.uniform(0.1, 0.28), rng.uniform(1.3, 2.6)
    radius, tall = rng.uniform(1.6, 3.5), rng.uniform(1.8, 3.3)
    fork = clear + 0.1 * tall
    solids = [_trunk(bark, thick, clear + 0.9 * tall)]
    boughs, first = int(rng.integers(3, 6)), rng.uniform(0, 2 * math.pi)
    for bough in range(boughs):
        angle = first + 2 * math.pi * (bough + rng.uniform(-0.25, 0.25)) / boughs
        size = rng.uniform(0.5, 0.75)
        away = (1 - size) * radius * rng.uniform(0.9, 1.4)
        height = clear + size * tall * rng.uniform(0.8, 1.0) + rng.uniform(0, 0.5) * tall
        x, y = away * math.cos(angle), away * math.sin(angle)
        solids.append(_clump(leaves, (x, y, height), size * radius, size * tall, rng))
        tip = (0.8 * x, 0.8 * y, max(height, fork + 0.5))
        solids.append(beam(bark, (0, 0, fork), tip, 0.4 * thick, 0.15 * thick))
    top = clear + rng.uniform(1.2, 1.5) * tall
    solids.append(_clump(leaves, (0, 0, top), 0.6 * radius, 0.65 * tall, rng))
    return solids


def _slender(rng: np.random.Generator, leaves: Material) -> list[Solid]:
    """A poplar or birch: clumps one above the other."""
    bark = Material("trunk", BIRCH, BARK) if rng.random() < 0.5 else _bark(rng)
    clear, tall = rng.uniform(0.9, 2.2), rng.uniform(4.0, 6.5)
    solids = [_trunk(bark, rng.uniform(0.09, 0.18), clear + 0.65 * tall)]
    clumps, radius = int(rng.integers(3, 5)), rng.uniform(1.1, 1.7)
    for clump in range(clumps):
        height = clear + tall * (clump + 0.5) / clumps
        wide = radius * rng.uniform(0.8, 1.0) * (1 - 0.45 * clump / clumps)
        dx, dy = rng.normal(0, 0.2, 2)
        solids.append(_clump(leaves, (dx, dy, height), wide, 0.85 * tall / clumps, rng))
    return solids


def _weeping(rng: np.random.Generator, leaves: Material) -> list[Solid]:
    """A dome with hanging leaves around it."""
    bark, clear = _bark(rng), rng.uniform(1.6, 2.4)
    radius, tall = rng.uniform(1.6, 2.6), rng.uniform(1.3, 2.1)
    solids = [_trunk(bark, rng.uniform(0.14, 0.26), clear + tall)]
    solids.append(_clump(leaves, (0, 0, clear + tall), radius, tall, rng))
    curtains, first = int(rng.integers(6, 10)), rng.uniform(0, 2 * math.pi)
    for curtain in range(curtains):
        angle = first + 2 * math.pi * (curtain + rng.uniform(-0.2, 0.2)) / curtains
        half = rng.uniform(0.38, 0.55) * (clear + tall)
        wide, away = rng.uniform(0.5, 0.8), rng.uniform(0.7, 0.95) * radius
        center = (away * math.cos(angle), away * math.sin(angle), clear + 1.1 * tall - half)
        solids.append(_clump(leaves, center, wide, half, rng))
    return solids


def _many_stemmed(rng: np.random.Generator, leaves: Material) -> list[Solid]:
    """Inclined stems from one point, each with its own crown."""
    bark, solids = _bark(rng), []
    stems, first = int(rng.integers(2, 5)), rng.uniform(0, 2 * math.pi)
    for stem in range(stems):
        angle = first + 2 * math.pi * (stem + rng.uniform(-0.3, 0.3)) / stems
        away, height = rng.uniform(0.5, 1.3), rng.uniform(2.4, 4.6)
        x, y = away * math.cos(angle), away * math.sin(angle)
        foot = (0.1 * math.cos(angle), 0.1 * math.sin(angle), -0.2)
        solids.append(beam(bark, foot, (x, y, height), rng.uniform(0.07, 0.13), 0.04))
        wide, half = rng.uniform(1.0, 1.7), rng.uniform(1.0, 1.9)
        solids.append(_clump(leaves, (1.1 * x, 1.1 * y, height), wide, half, rng))
    return solids


def conifer(rng: np.random.Generator, leaves: Material) -> Shape:
    """A conifer: tiers of dark needles almost down to the ground, or a pine with a bare trunk."""
    bark = _bark(rng)
    radius, half, low = rng.uniform(1.2, 2.3), rng.uniform(2.1, 4.3), rng.uniform(0.1, 1.2)
    green, blue = 0.65 * leaves.color[1], rng.uniform(0.4, 0.85)  # some are bluish
    needles = Material("vegetation", (0.6 * green, green, blue * green), LEAVES)
    if rng.random() < 0.2:
        stem = half + rng.uniform(1.0, 2.0)
        solids = [_trunk(bark, rng.uniform(0.12, 0.2), stem + 0.5)]
        for _ in range(rng.integers(2, 5)):
            dx, dy = rng.normal(0, 0.35 * radius, 2)
            height = stem + rng.uniform(-0.8, 0.8)
            solids.append(_clump(needles, (dx, dy, height), 0.8 * radius, 0.45 * radius, rng))
        return Shape((0.9, 0.9), solids)
    cone = Solid(needles, (0, 0, low + half), (radius, radius, half), LEAFY_CONE, density=0.7)
    return Shape((0.9, 0.9), [_trunk(bark, 0.16, low + half), cone])


def bush(rng: np.random.Generator, leaves: Material) -> Shape:
    """A bush, or a group of a few."""
    solids = []
    for _ in range(rng.integers(1, 5)):
        radius, half = rng.uniform(0.6, 1.6), rng.uniform(0.4, 1.25)
        dx, dy = rng.normal(0, 0.5, 2)
        solids.append(_clump(leaves, (dx, dy, 0.75 * half), radius, half, rng))
    return Shape((0.8, 0.8), solids)
