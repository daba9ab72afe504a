"""Puts trees, poles, vehicles and people into a street, each where it would be found."""

from __future__ import annotations

import math

import numpy as np

from occdetr.data.streets import objects
from occdetr.data.streets.build import build_street
from occdetr.data.streets.layout import Layout, Lot, Side, plan_street
from occdetr.data.streets.world import BARK, LEAVES, WORLD_SHAPE, Material, Part, World

WALKABLE = ("sidewalk", "other-ground", "terrain", "parking")
BARK_COLORS = ((0.30, 0.21, 0.14), (0.42, 0.36, 0.30))
# Trees and bushes on 16 m of a lot.
GREENERY = {
    "house": (6, 16),
    "garden": (9, 36),
    "woods": (24, 80),
    "field": (2, 16),
    "car park": (1, 5),
    "square": (2, 1),
}
NEAR, FAR = 7.0, 46.0  # metres ahead: where rare objects are put, so that the picture shows them


def make_street(rng: np.random.Generator) -> tuple[World, Layout]:
    """A whole random street."""
    world, layout = World(), plan_street(rng)
    build_street(world, layout, rng)
    x, y, yaw = layout.road.point(0.0, layout.lane)
    world.claim(x, y, yaw, (7.0, 2.4))  # the ego car's own place
    _add_traffic(world, layout, rng)
    _add_parked(world, layout, rng)
    _add_poles(world, layout, rng)
    _add_people(world, layout, rng)
    _add_trees(world, layout, rng)
    return world, layout


def _put(
    world: World,
    shape_function: objects.ShapeFunction,
    place: tuple[float, float, float],
    rng: np.random.Generator,
    on: tuple[str, ...] | None = None,
    margin: float = 0.3,
) -> bool:
    """Paint an object at (x, y, yaw) if there is room on the right ground."""
    x, y, yaw = place
    shape = shape_function(rng, yaw)
    if not world.claim(x, y, yaw, (shape.size[0] + margin, shape.size[1] + margin), on):
        return False
    world.paint(shape.parts, x, y, yaw)
    return True


def _add_traffic(world: World, layout: Layout, rng: np.random.Generator) -> None:
    """Moving vehicles: ahead in the ego lane, oncoming in the other."""
    for shape, odds, tries in (
        (objects.truck, 0.45, 4),
        (objects.other_vehicle, 0.45, 4),
        (objects.motorcyclist, 0.6, 5),
        (objects.bicyclist, 0.35, 3),
        (objects.car, 0.85, 4),
        (objects.car, 0.5, 3),
    ):
        if rng.random() > odds:
            continue
        for _ in range(tries):
            oncoming = rng.random() < 0.6
            along = rng.uniform(NEAR + 2 if oncoming else 14.0, FAR + 8)
            lateral = -layout.lane if oncoming else layout.lane
            x, y, yaw = layout.road.point(along, lateral + rng.normal(0, 0.25))
            yaw += math.pi * oncoming + rng.normal(0, 0.03)
            if _put(world, shape, (x, y, yaw), rng, ("road",), 0.6):
                break
    crossing = layout.crossing
    if crossing is not None and rng.random() < 0.6:
        side = crossing.side or rng.choice((-1, 1))
        lateral = side * (layout.road.half_width + rng.uniform(3, 9))
        along = crossing.along + crossing.skew * lateral + rng.uniform(-1, 1)
        x, y, yaw = layout.road.point(along, lateral)
        _put(world, objects.car, (x, y, yaw + math.pi / 2 - crossing.skew), rng, ("road",))


def _add_parked(world: World, layout: Layout, rng: np.random.Generator) -> None:
    """Cars in parking strips, on road edges and in car parks; sometimes a truck or motorcycle."""
    for side in layout.sides:
        wide = layout.road.half_width > 4.5
        if not (side.parking or (wide and rng.random() < 0.4) or rng.random() < 0.15):
            continue
        lateral = layout.road.half_width + (side.parking / 2 if side.parking else -1.05)
        density = rng.uniform(0.3, 0.95)
        along = rng.uniform(-4, 2)
        while along < 75:
            if rng.random() < density:
                x, y, yaw = layout.road.point(along, side.sign * lateral)
                turned = math.pi * (rng.random() < 0.8 if side.sign > 0 else rng.random() < 0.2)
                kinds = (objects.car, objects.motorcycle, objects.truck)
                shape = kinds[rng.choice(3, p=(0.88, 0.09, 0.03))]
                place = (x, y, yaw + turned + rng.normal(0, 0.03))
                _put(world, shape, place, rng, ("parking", "road"), 0.1)
            along += rng.uniform(5.2, 6.6)
    for lot in layout.lots:
        if lot.kind == "car park":
            _fill_car_park(world, layout, lot, rng)


def _fill_car_park(world: World, layout: Layout, lot: Lot, rng: np.random.Generator) -> None:
    for row in range(3):
        for along in np.arange(lot.start + 1.5, lot.end - 1.2, 2.7):
            if rng.random() < 0.45:
                continue
            depth = layout.road.half_width + lot.side.width + 3.0 + 7.5 * row
            x, y, yaw = layout.road.point(float(along), lot.side.sign * depth)
            turned = rng.choice((-1, 1)) * math.pi / 2 + rng.normal(0, 0.03)
            _put(world, objects.car, (x, y, yaw + turned), rng, ("parking",), 0.1)


def _add_poles(world: World, layout: Layout, rng: np.random.Generator) -> None:
    """Lamps in a row, signs here and there, traffic lights at a crossing."""
    for side in layout.sides:
        edge = layout.road.half_width + side.parking + rng.uniform(0.4, 0.9)
        if rng.random() < 0.6:
            for along in np.arange(rng.uniform(2, 14), 78, rng.uniform(12, 30)):
                _put_beside(world, layout, side, objects.lamp, float(along), edge, rng)
        for _ in range(rng.integers(0, 4)):
            along = rng.uniform(NEAR, FAR)
            _put_beside(world, layout, side, objects.traffic_sign, along, edge, rng)
    crossing = layout.crossing
    if crossing is not None and rng.random() < 0.5:
        for side in layout.sides:
            along = crossing.along - crossing.half_width - 1.2
            edge = layout.road.half_width + side.parking + 0.6
            _put_beside(world, layout, side, objects.traffic_light, along, edge, rng)


def _put_beside(
    world: World,
    layout: Layout,
    side: Side,
    shape: objects.ShapeFunction,
    along: float,
    edge: float,
    rng: np.random.Generator,
) -> None:
    """A pole at the road's edge: what hangs on it reaches over the road or faces the ego car."""
    x, y, yaw = layout.road.point(along, side.sign * edge)
    if side.sign > 0 and shape is objects.lamp:
        yaw += math.pi
    _put(world, shape, (x, y, yaw), rng, WALKABLE, 0.2)


def _add_people(world: World, layout: Layout, rng: np.random.Generator) -> None:
    """People, cyclists and parked two-wheelers, near enough for the picture to show them."""
    half = layout.road.half_width
    for shape, odds, most, spread, on in (
        (objects.person, 0.8, 5, (0.5, 6.0), WALKABLE),
        (objects.person, 0.25, 2, (-half, 0.0), ("road",)),
        (objects.bicyclist, 0.45, 2, (-1.6, -0.4), ("road", "parking")),
        (objects.bicyclist, 0.2, 1, (0.5, 3.0), ("sidewalk",)),
        (objects.bicycle, 0.6, 3, (0.3, 6.0), WALKABLE),
        (objects.motorcycle, 0.5, 2, (-0.6, 5.0), (*WALKABLE, "road")),
    ):
        if rng.random() > odds:
            continue
        wanted, tries = int(rng.integers(1, most + 1)), 0
        while wanted and tries < 25:
            tries += 1
            side = layout.sides[rng.integers(2)]
            along = NEAR + (FAR - NEAR) * rng.random() ** 1.5
            lateral = half + rng.uniform(*spread)
            x, y, yaw = layout.road.point(along, side.sign * lateral)
            upright = shape in (objects.person, objects.bicycle)
            turned = rng.uniform(-math.pi, math.pi) if upright else rng.normal(0, 0.15)
            turned += math.pi * (side.sign > 0)
            wanted -= _put(world, shape, (x, y, yaw + turned), rng, on, 0.2)


def _add_trees(world: World, layout: Layout, rng: np.random.Generator) -> None:
    """Street trees in the verge, trees and bushes on lots; many in woods, few in fields."""
    leaves = [_leaf_material(world, rng) for _ in range(6)]
    for side in layout.sides:
        if rng.random() < (0.7 if side.verge else 0.3):
            gap = rng.uniform(6, 14)
            edge = layout.road.half_width + side.parking + max(side.verge / 2, 0.7)
            for along in np.arange(rng.uniform(0, gap), 78, gap):
                x, y, _ = layout.road.point(float(along), side.sign * edge)
                _plant_tree(world, x, y, leaves, rng, street=True)
    area = {
        "house": (6, 16),
        "garden": (9, 36),
        "woods": (24, 80),
        "field": (2, 16),
        "square": (2, 1),
    }
    for lot in layout.lots:
        trees, bushes = area.get(lot.kind, (0, 2))
        scale = (lot.end - lot.start) / 16
        for tall, count in ((True, trees), (False, bushes)):
            for _ in range(rng.poisson(count * scale)):
                along = rng.uniform(lot.start, lot.end)
                lateral = layout.road.half_width + lot.side.width + rng.uniform(1.2, 26)
                x, y, _ = layout.road.point(along, lot.side.sign * lateral)
                if tall:
                    _plant_tree(world, x, y, leaves, rng, street=False)
                elif world.claim(x, y, 0.0, (0.6, 0.6), ("terrain",)):
                    _plant_bush(world, x, y, leaves, rng)


def _leaf_material(world: World, rng: np.random.Generator) -> int:
    green = rng.uniform(0.16, 0.34)
    autumn = rng.uniform(0.5, 0.85) if rng.random() < 0.8 else rng.uniform(1.0, 1.4)
    return world.palette.add("vegetation", (green * autumn, green, green * 0.35), LEAVES)


def _plant_tree(
    world: World,
    x: float,
    y: float,
    leaves: list[int],
    rng: np.random.Generator,
    street: bool,
) -> None:
    on = ("terrain", "sidewalk") if street else ("terrain", "other-ground")
    if not world.claim(x, y, 0.0, (0.8, 0.8), on):
        return
    material = leaves[rng.integers(len(leaves))]
    ground = world.height(x, y)
    thick = rng.uniform(0.11, 0.3)
    conifer = not street and rng.random() < 0.25
    radius, tall = (rng.uniform(1.4, 3.4), rng.uniform(2.2, 4.0))
    base = rng.uniform(0.4, 1.0) if conifer else rng.uniform(1.4, 2.8)
    trunk = Material("trunk", BARK_COLORS[rng.integers(len(BARK_COLORS))], BARK)
    top = min(base + tall * 0.8, 0.2 * WORLD_SHAPE[2] - ground - 3.0)
    world.paint([Part(trunk, (-thick, thick), (-thick, thick), (0.0, top))], x, y, 0.4)
    center = (x, y, ground + base + tall)
    density = rng.uniform(0.25, 0.5)
    world.scatter(material, center, (radius, tall), density, rng, cone=conifer)


def _plant_bush(
    world: World, x: float, y: float, leaves: list[int], rng: np.random.Generator
) -> None:
    tall = rng.uniform(0.4, 1.5)
    center = (x, y, world.height(x, y) + tall * 0.9)
    radii = (rng.uniform(0.6, 2.2), tall)
    world.scatter(leaves[rng.integers(len(leaves))], center, radii, rng.uniform(0.25, 0.5), rng)
