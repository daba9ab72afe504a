"""Ground truth of a street as SemanticKITTI makes it: from laser sweeps along the way ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from occdetr.data.streets.layout import Layout
from occdetr.data.streets.world import (
    SENSOR_HEIGHT,
    WORLD_ORIGIN,
    WORLD_SHAPE,
    World,
    crop_to_grid,
)
from occdetr.geometry.raycast import mark_traversed
from occdetr.geometry.voxels import VOXEL_SIZE

ROWS, TOP, BOTTOM = 64, math.radians(3.0), math.radians(-25.0)  # Velodyne HDL-64 of KITTI
RANGE = 70.0 / VOXEL_SIZE
FIRST_COLUMNS, LATER_COLUMNS = 1024, 640  # over the front 180 degrees, over all 360
SWEEPS = np.arange(3.0, 60.0, 4.0)  # metres along the road


@dataclass(frozen=True)
class Scan:
    """The four voxel files of a frame: classes 0-19, and three masks."""

    labels: UInt8[np.ndarray, "256 256 32"]
    invalid: Bool[np.ndarray, "256 256 32"]
    occluded: Bool[np.ndarray, "256 256 32"]
    hits: Bool[np.ndarray, "256 256 32"]


def scan_street(world: World, layout: Layout, rng: np.random.Generator) -> Scan:
    """Sweep from the ego position, then from places along its lane.

    A voxel is labelled if some sweep hits it, invalid if none hits or crosses it, occluded if the
    first one does neither.
    """
    occupied = world.materials
    first = np.zeros(WORLD_SHAPE, dtype=np.uint8)
    origin = np.zeros(3)
    azimuths = np.linspace(-math.pi / 2, math.pi / 2, FIRST_COLUMNS)
    mark_traversed(occupied, *_sweep(origin, azimuths), RANGE, first)
    seen = first.copy()
    for along in SWEEPS:
        x, y, _ = layout.road.point(float(along), layout.lane)
        origin = np.array([x, y, world.height(x, y) + VOXEL_SIZE / 2 + SENSOR_HEIGHT])
        turn = rng.uniform(0, 2 * math.pi / LATER_COLUMNS)
        azimuths = turn + np.linspace(-math.pi, math.pi, LATER_COLUMNS, endpoint=False)
        mark_traversed(occupied, *_sweep(origin, azimuths, rng), RANGE, seen)
    seen_now, seen_ever = crop_to_grid(first).astype(bool), crop_to_grid(seen).astype(bool)
    classes = crop_to_grid(world.classes)
    return Scan(
        labels=np.where(seen_ever, classes, 0).astype(np.uint8),
        invalid=~seen_ever,
        occluded=~seen_now,
        hits=seen_now & (classes > 0),
    )


def _sweep(
    origin: Float[np.ndarray, "3"],
    azimuths: Float[np.ndarray, " column"],
    rng: np.random.Generator | None = None,
) -> tuple[Float[np.ndarray, "ray 3"], Float[np.ndarray, "ray 3"]]:
    """The rays of one turn of the scanner, in voxel units of the world.

    With ``rng`` the rows are nodded by up to a row, as the car's pitching does over many scans.
    """
    nod = rng.uniform(-0.5, 0.5) * (TOP - BOTTOM) / ROWS if rng is not None else 0.0
    elevations = np.linspace(TOP, BOTTOM, ROWS) + nod
    azimuths, elevations = (a.ravel() for a in np.meshgrid(azimuths, elevations))
    directions = np.stack(
        [
            np.cos(elevations) * np.cos(azimuths),
            np.cos(elevations) * np.sin(azimuths),
            np.sin(elevations),
        ],
        axis=1,
    )
    start = (origin - np.array(WORLD_ORIGIN)) / VOXEL_SIZE
    return np.broadcast_to(start, directions.shape), directions
