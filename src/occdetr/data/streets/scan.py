"""Ground truth of a street as SemanticKITTI makes it: from laser sweeps along the way ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from occdetr.data.streets.layout import Layout
from occdetr.data.streets.world import (
    LEAVES,
    SENSOR_HEIGHT,
    WORLD_ORIGIN,
    WORLD_SHAPE,
    World,
    crop_to_grid,
)
from occdetr.geometry.raycast import mark_traversed
from occdetr.geometry.voxels import VOXEL_SIZE

# Elevations of Velodyne's HDL-64, and those above it: SemanticKITTI calls a voxel seen wherever
# nothing stands between it and a scanner's place, also over the scanner's field of view.
BEAMS = np.radians(np.linspace(3.0, -25.0, 64))
ABOVE = np.radians(np.linspace(4.0, 58.0, 36))
PASSING = 0.5  # of the voxels with leaves, those that a sweep looks through
RANGE = 70.0 / VOXEL_SIZE
FIRST_COLUMNS, LATER_COLUMNS = 1024, 512  # over the front 180 degrees, over all 360
SWEEPS = np.arange(2.5, 62.0, 3.0)  # metres along the road


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
    thinned = _thin_foliage(world, rng)
    hits, first = np.zeros(WORLD_SHAPE, dtype=np.uint8), np.zeros(WORLD_SHAPE, dtype=np.uint8)
    front = np.linspace(-math.pi / 2, math.pi / 2, FIRST_COLUMNS)
    mark_traversed(thinned[0], *_sweep(np.zeros(3), front, BEAMS), RANGE, hits)
    mark_traversed(thinned[0], *_sweep(np.zeros(3), front, ABOVE), RANGE, first)
    first |= hits
    seen = first.copy()
    turn = np.linspace(-math.pi, math.pi, LATER_COLUMNS, endpoint=False)
    for number, along in enumerate(SWEEPS):
        occupied = thinned[number % 2]
        x, y, _ = layout.road.point(float(along), layout.lane)
        place = np.array([x, y, world.height(x, y) + VOXEL_SIZE / 2 + SENSOR_HEIGHT])
        # over many scans the car turns and nods: no beam falls on the same spot twice
        azimuths = turn + rng.uniform(0, turn[1] - turn[0])
        nod = rng.uniform(0, BEAMS[0] - BEAMS[1])
        mark_traversed(occupied, *_sweep(place, azimuths, BEAMS + nod), RANGE, seen)
        mark_traversed(occupied, *_sweep(place, azimuths[::2], ABOVE + nod), RANGE, seen)
    seen_now, seen_ever = crop_to_grid(first).astype(bool), crop_to_grid(seen).astype(bool)
    classes = crop_to_grid(world.classes)
    return Scan(
        labels=np.where(seen_ever, classes, 0).astype(np.uint8),
        invalid=~seen_ever,
        occluded=~seen_now,
        hits=crop_to_grid(hits).astype(bool) & (classes > 0),
    )


def _thin_foliage(world: World, rng: np.random.Generator) -> list[np.ndarray]:
    """Two copies of the world, each without a random part of the foliage: beams pass through
    leaves here and there, so that over all sweeps trees are labelled inside as well."""
    foliage = (world.palette.kinds == LEAVES)[world.materials]
    places = np.flatnonzero(foliage)
    copies = [world.materials.copy() for _ in range(2)]
    for copy in copies:
        copy.reshape(-1)[places[rng.random(len(places), dtype=np.float32) < PASSING]] = 0
    return copies


def _sweep(
    origin: Float[np.ndarray, " 3"],
    azimuths: Float[np.ndarray, " column"],
    elevations: Float[np.ndarray, " row"],
) -> tuple[Float[np.ndarray, "ray 3"], Float[np.ndarray, "ray 3"]]:
    """The rays of one turn of the scanner, in voxel units of the world."""
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
