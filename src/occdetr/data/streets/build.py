"""Builds a planned street out of voxels: its ground, houses, fences and hedges."""

from __future__ import annotations

import numpy as np

from occdetr.data.streets.layout import Layout, Lot, Side
from occdetr.data.streets.world import (
    ASPHALT,
    CELL_X,
    CELL_Y,
    FENCE,
    GRASS,
    GRAVEL,
    LEAVES,
    PARKING,
    PAVING,
    SENSOR_HEIGHT,
    WALL,
    WORLD_ORIGIN,
    WORLD_SHAPE,
    World,
)
from occdetr.geometry.voxels import VOXEL_SIZE

WALL_COLORS = (
    (0.86, 0.84, 0.80),
    (0.83, 0.74, 0.56),
    (0.62, 0.30, 0.22),
    (0.72, 0.55, 0.42),
    (0.70, 0.70, 0.72),
    (0.80, 0.62, 0.55),
)
ROOF_COLORS = ((0.60, 0.26, 0.17), (0.35, 0.20, 0.16), (0.30, 0.30, 0.33))
FENCE_COLORS = ((0.45, 0.30, 0.18), (0.82, 0.80, 0.76), (0.25, 0.27, 0.28), (0.55, 0.42, 0.28))


def build_street(world: World, layout: Layout, rng: np.random.Generator) -> None:
    """Lay the ground and put up all that is fixed to it, except trees and poles."""
    x, y = np.meshgrid(CELL_X, CELL_Y, indexing="ij")
    along, lateral = layout.road.locate(x, y)
    crossing, curb = _crossing_masks(layout, along, lateral)
    _lay_ground(world, layout, along, lateral, crossing, curb, rng)
    for lot in layout.lots:
        edge = lateral * lot.side.sign - layout.road.half_width - lot.side.width
        allowed = (edge > 0) & ~crossing & ~curb & (along >= lot.start) & (along < lot.end)
        _build_lot(world, layout, lot, allowed, edge, along, rng)


def _crossing_masks(
    layout: Layout, along: np.ndarray, lateral: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cells of the side road, and of the pavement along it."""
    crossing = layout.crossing
    if crossing is None:
        return np.zeros(along.shape, dtype=bool), np.zeros(along.shape, dtype=bool)
    distance = np.abs(along - crossing.along - crossing.skew * lateral)
    side = (lateral * crossing.side >= 0) & (np.abs(lateral) >= layout.road.half_width)
    return (
        side & (distance < crossing.half_width),
        side & (distance >= crossing.half_width) & (distance < crossing.half_width + 2.0),
    )


def _lay_ground(
    world: World,
    layout: Layout,
    along: np.ndarray,
    lateral: np.ndarray,
    crossing: np.ndarray,
    curb: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """Choose ground materials and heights, and fill the world up to them."""
    ground = _ground_materials(world, rng)
    cover = np.full(along.shape, ground["terrain"], dtype=np.uint8)
    raised = np.zeros(along.shape, dtype=np.float32)
    for side in layout.sides:
        _cover_side(cover, raised, side, layout, along, lateral, ground, rng)
    cover[curb], raised[curb] = ground["sidewalk"], 0.16
    road = (np.abs(lateral) < layout.road.half_width) | crossing
    cover[road], raised[road] = ground["road"], 0.0

    beyond = np.abs(lateral) - layout.road.half_width - 6
    bank = np.clip(beyond, 0, 12) * np.where(lateral > 0, *rng.normal(0.02, 0.05, 2))
    slope = along * rng.normal(0, 0.004) + lateral * rng.normal(0, 0.006)
    height = -SENSOR_HEIGHT + slope + raised + np.where(crossing | curb, 0.0, bank)
    index = np.floor((height - WORLD_ORIGIN[2]) / VOXEL_SIZE)
    world.ground[:] = np.clip(index, 0, WORLD_SHAPE[2] // 3)
    world.ground_class[:] = world.palette.classes[cover]
    below = np.arange(WORLD_SHAPE[2]) <= world.ground[:, :, None]
    np.copyto(world.materials, cover[:, :, None], where=below)


def _ground_materials(world: World, rng: np.random.Generator) -> dict[str, int]:
    grey, warm = rng.uniform(0.27, 0.42), rng.normal(0, 0.012)
    pave = rng.uniform(0.50, 0.66)
    brick = rng.random() < 0.5
    green, dry = rng.uniform(0.36, 0.52), rng.uniform(0.0, 0.22)
    sand = rng.uniform(0.48, 0.66)
    add = world.palette.add
    return {
        "road": add("road", (grey + warm, grey, grey - warm), ASPHALT),
        "sidewalk": add("sidewalk", (pave + 0.02, pave - 0.02, pave - 0.05), PAVING),
        "parking": add("parking", (0.50, 0.36, 0.31) if brick else (0.22, 0.23, 0.27), PARKING),
        "terrain": add("terrain", (green * (0.75 + dry), green, green * 0.42), GRASS),
        "other-ground": add("other-ground", (sand, sand * 0.86, sand * 0.62), GRAVEL),
    }


def _cover_side(
    cover: np.ndarray,
    raised: np.ndarray,
    side: Side,
    layout: Layout,
    along: np.ndarray,
    lateral: np.ndarray,
    ground: dict[str, int],
    rng: np.random.Generator,
) -> None:
    """Lots first, then the strips from the road outwards."""
    edge = lateral * side.sign - layout.road.half_width
    for lot in layout.lots:
        if lot.side is not side:
            continue
        cells = (edge >= side.width) & (along >= lot.start) & (along < lot.end)
        names = {"car park": "parking", "square": "other-ground"}
        paved = lot.kind == "house" and layout.style == "urban" and rng.random() < 0.6
        cover[cells] = ground[names.get(lot.kind, "sidewalk" if paved else "terrain")]
        raised[cells] = 0.0 if lot.kind == "car park" else 0.16
    start = 0.0
    level = 0.0 if rng.random() < 0.7 else 0.16
    for name, width, height in (
        ("parking", side.parking, level),
        ("terrain", side.verge, 0.16),
        ("sidewalk", side.sidewalk, 0.16),
    ):
        cells = (edge >= start) & (edge < start + width)
        cover[cells], raised[cells] = ground[name], height
        start += width


def _build_lot(
    world: World,
    layout: Layout,
    lot: Lot,
    allowed: np.ndarray,
    edge: np.ndarray,
    along: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """The house of a lot, and the fence or hedge at its front."""
    if lot.kind == "house":
        _build_house(world, layout, lot, allowed, rng)
    front = {"house": 0.7, "garden": 0.95, "woods": 0.4, "field": 0.6}.get(lot.kind, 0.0)
    if lot.setback > 1.2 and rng.random() < front:
        _build_boundary(world, layout, lot, allowed, edge, along, rng)
    if lot.kind in ("house", "garden") and rng.random() < 0.5:  # between two neighbours
        strip = allowed & (along < lot.start + 0.4) & (edge < rng.uniform(4, 14))
        _build_barrier(world, layout, strip & ~world.taken, along, rng)


def _build_house(
    world: World, layout: Layout, lot: Lot, allowed: np.ndarray, rng: np.random.Generator
) -> None:
    width = lot.end - lot.start - rng.uniform(0.0 if layout.style == "urban" else 2.0, 7.0)
    depth = rng.uniform(7, 13)
    lateral = layout.road.half_width + lot.side.width + lot.setback + depth / 2
    x, y, yaw = layout.road.point((lot.start + lot.end) / 2, lot.side.sign * lateral)
    columns, ahead, left = world.window(x, y, yaw, 0.75 * max(width, depth))
    footprint = (np.abs(ahead) < width / 2) & (np.abs(left) < depth / 2) & allowed[columns]
    eaves = rng.uniform(2.8, 9.5 if layout.style == "urban" else 6.5)
    color = np.array(WALL_COLORS[rng.integers(len(WALL_COLORS))]) * rng.uniform(0.85, 1.1)
    wall = world.palette.add("building", color, WALL, yaw)
    roof = world.palette.add("building", ROOF_COLORS[rng.integers(len(ROOF_COLORS))], yaw=yaw)
    pitch = rng.uniform(0.5, 0.9) if rng.random() < 0.7 else 0.0
    cells = np.zeros(allowed.shape, dtype=bool)
    cells[columns] = footprint
    top = np.full(allowed.shape, eaves)
    top[columns] = eaves + 0.2 + pitch * np.clip(depth / 2 - np.abs(left), 0, None)
    world.raise_columns(cells, top, roof)
    world.raise_columns(cells, eaves, wall)


def _build_boundary(
    world: World,
    layout: Layout,
    lot: Lot,
    allowed: np.ndarray,
    edge: np.ndarray,
    along: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """A fence or hedge along the front of a lot, with a gate in it."""
    gate = rng.uniform(lot.start, lot.end)
    strip = allowed & (edge < 0.4) & (np.abs(along - gate) > rng.uniform(0.6, 2.0))
    _build_barrier(world, layout, strip & ~world.taken, along, rng)


def _build_barrier(
    world: World, layout: Layout, cells: np.ndarray, along: np.ndarray, rng: np.random.Generator
) -> None:
    if rng.random() < 0.65:
        color = np.array(FENCE_COLORS[rng.integers(len(FENCE_COLORS))]) * rng.uniform(0.8, 1.1)
        yaw = float(layout.road.heading(float(along[cells].mean()))) if cells.any() else 0.0
        material = world.palette.add("fence", color, FENCE, yaw)
        world.raise_columns(cells, rng.uniform(0.8, 2.0), material)
        return
    green = rng.uniform(0.18, 0.30)
    material = world.palette.add("vegetation", (green * 0.65, green, green * 0.4), LEAVES)
    ragged = rng.uniform(1.0, 2.4) + rng.normal(0, 0.15, cells.shape)
    world.raise_columns(cells & (rng.random(cells.shape) < 0.93), ragged, material)
