"""Places trees, poles, vehicles and people in a street, each at plausible positions."""

from __future__ import annotations

import math

import numpy as np

from occdetr.streets import greenery, objects
from occdetr.streets.buildings import build_lots
from occdetr.streets.ground import Plan, make_plan, make_terrain
from occdetr.streets.layout import Layout, Lot, Side, plan_street
from occdetr.streets.scene import Motion, Scene
from occdetr.streets.solids import (
    ASPHALT,
    GRASS,
    GRAVEL,
    PARKING,
    PAVING,
    Color,
    ShapeFunction,
)

BEHIND, AHEAD, BESIDE = 10.0, 94.0, 44.0  # extent of the world around the first pose in metres
DRIVE = 16.0  # additional metres for later scans
WALKABLE = ("sidewalk", "other-ground", "terrain", "parking")
NEAR, FAR = 7.0, 48.0  # metres ahead at which rare objects are placed, so that the image shows them
#: Numbers of trees and bushes on 16 m of a lot.
GREENERY = {
    "house": (1.2, 30),
    "garden": (3, 60),
    "woods": (8, 110),
    "field": (1, 45),
    "car park": (1, 5),
    "square": (2, 1),
}


def plan_world(rng: np.random.Generator) -> tuple[Layout, Plan]:
    """The plan of a world's street, which is the first use of its random numbers."""
    layout = plan_street(rng, AHEAD + DRIVE)
    return layout, make_plan(layout, rng)


def make_street(rng: np.random.Generator) -> Scene:
    """A random street with all its objects."""
    layout, plan = plan_world(rng)
    scene = Scene(layout, plan, make_terrain(plan, (-BEHIND, AHEAD + DRIVE), (-BESIDE, BESIDE)))
    scene.lay(_surface_colors(rng))
    x, y, yaw = layout.road.point(layout.start, layout.lane)
    scene.claim(x, y, yaw, (7.0, 2.4))  # the place of the ego car
    build_lots(scene, rng)
    _add_traffic(scene, rng)
    _add_parked(scene, rng)
    _add_poles(scene, rng)
    _add_people(scene, rng)
    _add_greenery(scene, rng)
    return scene


def _surface_colors(rng: np.random.Generator) -> dict[str, tuple[Color, int]]:
    """Colour and texture of every surface of the ground."""
    grey, warm = rng.uniform(0.26, 0.40), rng.normal(0, 0.012)
    pave = rng.uniform(0.48, 0.64)
    green, dry = rng.uniform(0.34, 0.50), rng.uniform(0.0, 0.25)
    sand = rng.uniform(0.48, 0.64)
    brick = rng.random() < 0.6
    return {
        "road": ((grey + warm, grey, grey - warm), ASPHALT),
        "sidewalk": ((pave + 0.02, pave - 0.01, pave - 0.04), PAVING),
        "parking": ((0.50, 0.37, 0.32) if brick else (0.24, 0.25, 0.29), PARKING),
        "terrain": ((green * (0.75 + dry), green, green * 0.42), GRASS),
        "other-ground": ((sand, sand * 0.86, sand * 0.62), GRAVEL),
    }


def _add_traffic(scene: Scene, rng: np.random.Generator) -> None:
    """Add moving vehicles ahead in the ego lane, oncoming in the other, and on the side road."""
    layout = scene.layout
    for shape, odds, tries in (
        (objects.truck, 0.05, 4),
        (objects.other_vehicle, 0.12, 4),
        (objects.motorcyclist, 0.40, 5),
        (objects.bicyclist, 0.18, 3),
        (objects.car, 0.75, 4),
        (objects.car, 0.5, 3),
        (objects.car, 0.3, 3),
    ):
        if rng.random() > odds:
            continue
        for _ in range(tries):
            oncoming = rng.random() < 0.6
            along = rng.uniform(NEAR + 2 if oncoming else 12.0, FAR + 10)
            lateral = (-layout.lane if oncoming else layout.lane) + rng.normal(0, 0.2)
            yaw = math.pi * oncoming + rng.normal(0, 0.03)
            speed = -rng.uniform(4, 14) if oncoming else layout.speed * rng.uniform(0.9, 1.1)
            motion = Motion(along, lateral, yaw, speed)
            if scene.try_put(shape(rng), motion, ("road",), 0.6):
                break
    crossing = layout.crossing
    if crossing is not None and rng.random() < 0.6:
        side = crossing.side or int(rng.choice((-1, 1)))
        lateral = side * (layout.road.half_width + rng.uniform(3, 9))
        along = crossing.along + crossing.skew * lateral + rng.uniform(-1, 1)
        motion = Motion(along, lateral, math.pi / 2 - crossing.skew, drift=rng.uniform(-1, 1))
        scene.try_put(objects.car(rng), motion, ("road",))


def _add_parked(scene: Scene, rng: np.random.Generator) -> None:
    """Add cars, and sometimes other vehicles, in parking strips, on road edges, on driveways and in
    car parks."""
    layout = scene.layout
    for side in layout.sides:
        wide = layout.road.half_width > 4.2
        if not (side.parking or (wide and rng.random() < 0.35) or rng.random() < 0.1):
            continue
        lateral = layout.road.half_width + (side.parking / 2 if side.parking else -1.05)
        density = rng.uniform(0.25, 0.9)
        along = rng.uniform(-4, 2)
        while along < 78:
            if rng.random() < density:
                turned = math.pi * (rng.random() < (0.8 if side.sign > 0 else 0.2))
                kinds = (objects.car, objects.motorcycle, objects.truck, objects.other_vehicle)
                shape = kinds[rng.choice(4, p=(0.97, 0.008, 0.01, 0.012))]
                yaw = turned + rng.normal(0, 0.03)
                motion = Motion(along, side.sign * lateral, yaw)
                scene.try_put(shape(rng), motion, ("parking", "road"), 0.1)
            along += rng.uniform(5.2, 6.6)
    for lot in layout.lots:
        if lot.kind == "car park":
            _fill_car_park(scene, lot, rng)
        elif lot.driveway[2] > 3 and rng.random() < 0.6:
            depth = layout.edge(lot.side) + min(lot.driveway[2], lot.setback + 1) - 2.2
            turned = float(rng.choice((-1, 1))) * math.pi / 2 + rng.normal(0, 0.04)
            middle = (lot.driveway[0] + lot.driveway[1]) / 2
            shape = objects.other_vehicle if rng.random() < 0.05 else objects.car
            scene.try_put(shape(rng), Motion(middle, lot.side.sign * depth, turned), ("parking",))


def _fill_car_park(scene: Scene, lot: Lot, rng: np.random.Generator) -> None:
    for row in range(3):
        for along in np.arange(lot.start + 1.5, lot.end - 1.2, 2.7):
            if rng.random() < 0.5:
                continue
            depth = scene.layout.edge(lot.side) + 3.0 + 7.5 * row
            turned = float(rng.choice((-1, 1))) * math.pi / 2 + rng.normal(0, 0.03)
            motion = Motion(float(along), lot.side.sign * depth, turned)
            scene.try_put(objects.car(rng), motion, ("parking",), 0.1)


def _add_poles(scene: Scene, rng: np.random.Generator) -> None:
    """Add lamps in a row, signs and bollards, and traffic lights at a crossing."""
    layout = scene.layout
    for side in layout.sides:
        edge = layout.road.half_width + side.parking + rng.uniform(0.4, 0.9)
        if rng.random() < 0.6:
            for along in np.arange(rng.uniform(2, 14), 80, rng.uniform(12, 30)):
                _put_beside(scene, side, objects.lamp, float(along), edge, rng)
        for _ in range(rng.integers(0, 3)):
            _put_beside(scene, side, objects.traffic_sign, rng.uniform(NEAR, FAR), edge, rng)
        if rng.random() < 0.2:
            start = rng.uniform(5, 40)
            for along in np.arange(start, start + rng.uniform(4, 14), 1.6):
                _put_beside(scene, side, objects.bollard, float(along), edge, rng)
    crossing = layout.crossing
    if crossing is not None and rng.random() < 0.5:
        for side in layout.sides:
            along = crossing.along - crossing.half_width - 1.2
            edge = layout.road.half_width + side.parking + 0.6
            _put_beside(scene, side, objects.traffic_light, along, edge, rng)


def _put_beside(
    scene: Scene,
    side: Side,
    shape: ShapeFunction,
    along: float,
    edge: float,
    rng: np.random.Generator,
) -> None:
    """Put a pole at the road's edge, with its arm over the road or its sign towards the ego car."""
    yaw = math.pi if side.sign > 0 and shape is objects.lamp else 0.0
    scene.try_put(shape(rng), Motion(along, side.sign * edge, yaw), WALKABLE, 0.2)


def _add_people(scene: Scene, rng: np.random.Generator) -> None:
    """Add people, cyclists and parked two-wheelers, near enough to be visible in the image."""
    layout = scene.layout
    half = layout.road.half_width
    for shape, odds, most, spread, on, speed in (
        (objects.person, 0.5, 3, (0.5, 6.0), WALKABLE, 1.4),
        (objects.person, 0.12, 2, (-half, 0.0), ("road",), 0.0),
        (objects.bicyclist, 0.2, 2, (-1.6, -0.4), ("road", "parking"), 4.5),
        (objects.bicyclist, 0.15, 1, (0.5, 3.0), ("sidewalk",), 3.5),
        (objects.bicycle, 0.35, 2, (0.3, 6.0), WALKABLE, 0.0),
        (objects.motorcycle, 0.18, 2, (-0.6, 5.0), (*WALKABLE, "road"), 0.0),
    ):
        if rng.random() > odds:
            continue
        wanted, tries = int(rng.integers(1, most + 1)), 0
        while wanted and tries < 25:
            tries += 1
            side = layout.sides[rng.integers(2)]
            along = NEAR + (FAR - NEAR) * rng.random() ** 1.5
            lateral = side.sign * (half + rng.uniform(*spread))
            back = side.sign > 0
            if speed == 0.0:
                motion = Motion(along, lateral, rng.uniform(-math.pi, math.pi))
            else:
                back ^= rng.random() < (0.5 if speed < 2 else 0.05)
                pace = speed * rng.uniform(0.6, 1.3) * (-1 if back else 1)
                motion = Motion(along, lateral, math.pi * back + rng.normal(0, 0.1), pace)
            wanted -= scene.try_put(shape(rng), motion, on, 0.2)


def _add_greenery(scene: Scene, rng: np.random.Generator) -> None:
    """Add street trees, and trees and bushes on lots: many in woods, few in fields."""
    layout = scene.layout
    leaves = [greenery.leaf_material(rng) for _ in range(6)]
    for side in layout.sides:
        if rng.random() < (0.6 if side.verge else 0.2):
            gap, kind = rng.uniform(6, 14), leaves[rng.integers(len(leaves))]
            edge = layout.road.half_width + side.parking + max(side.verge / 2, 0.7)
            for along in np.arange(rng.uniform(0, gap), 80, gap):
                motion = Motion(float(along), side.sign * edge, rng.uniform(0, 6))
                scene.try_put(greenery.tree(rng, kind), motion, ("terrain", "sidewalk"), 0.0)
    for lot in layout.lots:
        trees, bushes = GREENERY[lot.kind]
        scale = (lot.end - lot.start) / 16
        for count, shapes in (
            (trees, (greenery.tree, greenery.tree, greenery.tree, greenery.conifer)),
            (bushes, (greenery.bush,)),
        ):
            for _ in range(rng.poisson(count * scale)):
                along = rng.uniform(lot.start, lot.end)
                lateral = lot.side.sign * (layout.edge(lot.side) + rng.uniform(1.2, 26))
                shape = shapes[rng.integers(len(shapes))](rng, leaves[rng.integers(len(leaves))])
                motion = Motion(along, lateral, rng.uniform(0, 6))
                scene.try_put(shape, motion, ("terrain", "other-ground"), 0.0)
