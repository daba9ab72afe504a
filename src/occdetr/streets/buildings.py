"""Houses, fences, walls and hedges of the lots along a street."""

from __future__ import annotations

import numpy as np

from occdetr.streets.layout import Lot
from occdetr.streets.scene import Motion, Scene
from occdetr.streets.solids import (
    FENCE,
    LEAFY_BOX,
    LEAVES,
    METAL,
    PLAIN,
    ROOF,
    STONE,
    WALL,
    Color,
    Material,
    Solid,
    box,
)

WALL_COLORS = (
    (0.86, 0.84, 0.80),
    (0.84, 0.75, 0.58),
    (0.58, 0.29, 0.22),
    (0.72, 0.55, 0.42),
    (0.70, 0.70, 0.72),
    (0.80, 0.64, 0.56),
    (0.66, 0.72, 0.66),
)
ROOF_COLORS = ((0.56, 0.25, 0.17), (0.36, 0.21, 0.17), (0.30, 0.30, 0.33), (0.44, 0.33, 0.28))
FENCE_COLORS = ((0.45, 0.30, 0.18), (0.80, 0.78, 0.74), (0.28, 0.30, 0.31), (0.55, 0.42, 0.28))
STONE_COLORS = ((0.62, 0.60, 0.56), (0.55, 0.40, 0.33), (0.74, 0.71, 0.66))
SEGMENT = 3.0  # length of a piece of fence in metres; pieces follow the road's curve
FRONT = {"house": 0.75, "garden": 0.95, "woods": 0.35, "field": 0.6}


def build_lots(scene: Scene, rng: np.random.Generator) -> None:
    """Build houses, and the barriers between lots and along their fronts."""
    for lot in scene.layout.lots:
        if lot.kind == "house":
            _build_house(scene, lot, rng)
    for lot in scene.layout.lots:
        edge = scene.layout.edge(lot.side)
        if lot.setback > 1.2 and rng.random() < FRONT.get(lot.kind, 0.0):
            _build_barrier(scene, lot, (lot.start, lot.end), (edge + 0.25, edge + 0.25), rng)
        if lot.kind in ("house", "garden", "field") and rng.random() < 0.6:
            depth = rng.uniform(5, 18)
            _build_barrier(scene, lot, (lot.start, lot.start), (edge + 0.5, edge + depth), rng)
        if lot.kind in ("garden", "house") and rng.random() < 0.35:
            back = edge + rng.uniform(12, 20)
            _build_barrier(scene, lot, (lot.start, lot.end), (back, back), rng)


def _tone(colors: tuple[Color, ...], rng: np.random.Generator) -> Color:
    red, green, blue = np.array(colors[rng.integers(len(colors))]) * rng.uniform(0.85, 1.1)
    return float(red), float(green), float(blue)


def _darker(color: Color) -> Color:
    return 0.8 * color[0], 0.8 * color[1], 0.8 * color[2]


def _build_house(scene: Scene, lot: Lot, rng: np.random.Generator) -> None:
    """Build the house of a lot, smaller if it must fit between neighbours and side streets."""
    urban = scene.layout.style == "urban"
    width = lot.end - lot.start - rng.uniform(0.0 if urban else 2.0, 3.0 if urban else 7.0)
    depth = rng.uniform(7, 13)
    lateral = lot.side.sign * (scene.layout.edge(lot.side) + lot.setback + depth / 2)
    middle = (lot.start + lot.end) / 2
    for share, shift in ((1.0, 0.0), (0.6, -0.2), (0.6, 0.2), (0.35, -0.32), (0.35, 0.32)):
        motion = Motion(middle + shift * width, lateral)
        x, y, yaw = scene.place(motion)
        if not _on_land(scene, x, y, yaw, share * width + 0.6, depth + 0.6):
            continue
        if scene.claim(x, y, yaw, (share * width, depth)):
            solids = house(share * width, depth, 10.0 if urban else 6.5, lot.side.sign, rng)
            scene.put(solids, x, y, yaw)
            return


def _on_land(scene: Scene, x: float, y: float, yaw: float, length: float, width: float) -> bool:
    """Whether a rectangle overlaps no road, sidewalk or kerb."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    paved = scene.terrain.surface
    for a in np.linspace(-length / 2, length / 2, 7):
        for b in (-width / 2, 0.0, width / 2):
            if paved(x + cos * a - sin * b, y + sin * a + cos * b) == "road":
                return False
    return True


def house(
    width: float, depth: float, tallest: float, sign: int, rng: np.random.Generator
) -> list[Solid]:
    """Walls with windows, a roof, a chimney, steps and balconies. The front faces -y on the left
    side of the street (sign 1) and +y on the right."""
    eaves = rng.uniform(2.9, tallest)
    wall = Material("building", _tone(WALL_COLORS, rng), WALL)
    roof = Material("building", _tone(ROOF_COLORS, rng), ROOF)
    trim = Material("building", (0.82, 0.80, 0.76), PLAIN)
    hx, hy, front = width / 2, depth / 2, -sign * depth / 2
    solids = [box(wall, (-hx, hx), (-hy, hy), (-0.8, eaves))]
    if rng.random() < 0.75:
        over, rise = rng.uniform(0.2, 0.6), rng.uniform(0.4, 0.9) * hy
        hip = 1.0 if rng.random() < 0.7 else max(1.0 - depth / width, 0.1)
        limits = ((-hx - over, hx + over), (-hy - over, hy + over), (eaves, eaves + rise))
        solids.append(box(roof, *limits, taper=(hip, 0.02)))
        x = rng.uniform(-0.4, 0.4) * width
        solids.append(box(wall, (x - 0.35, x + 0.35), (-0.4, 0.4), (eaves, eaves + rise + 0.6)))
    else:
        solids.append(box(trim, (-hx - 0.1, hx + 0.1), (-hy - 0.1, hy + 0.1), (eaves, eaves + 0.3)))
    x = rng.uniform(-0.35, 0.35) * width
    step = sorted((front, front - sign * rng.uniform(0.6, 1.2)))
    solids.append(box(trim, (x - 0.9, x + 0.9), (step[0], step[1]), (-0.3, 0.3)))
    if eaves > 5 and rng.random() < 0.5:
        edge = sorted((front, front - sign * 1.1))
        for x in np.arange(-hx + 1.5, hx - 2.5, 4.2):
            solids.append(box(trim, (x, x + 2.4), (edge[0], edge[1]), (2.75, 3.7)))
    return solids


def _build_barrier(
    scene: Scene,
    lot: Lot,
    along: tuple[float, float],
    lateral: tuple[float, float],
    rng: np.random.Generator,
) -> None:
    """Build a fence, wall or hedge between two points of a lot; long ones have a gate."""
    length = float(np.hypot(along[1] - along[0], lateral[1] - lateral[0]))
    pieces = max(round(length / SEGMENT), 1)
    gate = rng.uniform(0, 1) if lateral[0] == lateral[1] else 2.0
    turned = 0.0 if lateral[0] == lateral[1] else np.pi / 2
    make = _fence(rng) if rng.random() < 0.62 else _hedge(rng)
    for piece in range(pieces):
        middle = (piece + 0.5) / pieces
        a = along[0] + middle * (along[1] - along[0])
        b = lot.side.sign * (lateral[0] + middle * (lateral[1] - lateral[0]))
        if abs(middle - gate) < 0.6 / pieces:
            continue
        motion = Motion(a, b, turned)
        x, y, yaw = scene.place(motion)
        span = length / pieces
        ends = [(x + s * span * np.cos(yaw), y + s * span * np.sin(yaw)) for s in (-0.5, 0, 0.5)]
        surfaces = {scene.terrain.surface(*end) for end in ends}
        if surfaces & {"road", "parking"} or not scene.claim(x, y, yaw, (span - 0.4, 0.2)):
            continue
        scene.put(make(span, rng), x, y, yaw)


def _fence(rng: np.random.Generator):
    """A function that makes the pieces of one fence or wall."""
    height = rng.uniform(0.8, 2.0)
    if rng.random() < 0.35:
        stone = Material("fence", _tone(STONE_COLORS, rng), STONE)
        return lambda span, _: [
            box(stone, (-span / 2, span / 2), (-0.14, 0.14), (-0.4, height)),
        ]
    metal = rng.random() < 0.25
    panel = Material("fence", _tone(FENCE_COLORS, rng), METAL if metal else FENCE)
    post = Material("fence", _darker(panel.color), METAL)
    return lambda span, _: [
        box(panel, (-span / 2, span / 2), (-0.04, 0.04), (-0.2 if not metal else 0.08, height)),
        box(post, (-span / 2 - 0.06, -span / 2 + 0.06), (-0.07, 0.07), (-0.3, height + 0.1)),
    ]


def _hedge(rng: np.random.Generator):
    """A function that makes the pieces of one hedge."""
    height, half = rng.uniform(0.9, 2.3), rng.uniform(0.3, 0.6)
    green = rng.uniform(0.17, 0.30)
    leaves = Material("vegetation", (green * rng.uniform(0.55, 0.8), green, green * 0.4), LEAVES)

    def piece(span: float, rng: np.random.Generator) -> list[Solid]:
        half_height = 0.5 * (height + rng.normal(0, 0.06)) + 0.1
        center = (0.0, 0.0, half_height - 0.2)
        size = (span / 2 + 0.05, half, half_height)
        return [Solid(leaves, center, size, LEAFY_BOX, density=0.75)]

    return piece
