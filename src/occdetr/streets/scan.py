"""Ground truth of a street as in SemanticKITTI: fused laser sweeps along the way ahead.

Sweeps are cast through the voxels that contain surfaces. Moving objects stand still meanwhile, as
if SemanticKITTI compensated for their motion, so they leave no trails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from occdetr.geometry.raycast import mark_swept
from occdetr.geometry.voxels import GRID_SHAPE, metres_to_voxels
from occdetr.streets.voxelize import Voxels

# Elevations of Velodyne's HDL-64, and those above it: in SemanticKITTI a voxel is visible if no hit
# voxel is between it and a position of the scanner, even above the field of view.
BEAMS = np.radians(np.linspace(2.0, -24.8, 64))
ABOVE = np.radians(np.concatenate([np.linspace(3.0, 20.0, 18), np.linspace(22.0, 70.0, 16)]))
PASSING = 0.7  # share of leaf voxels that a sweep passes
RANGE = 70.0 / 0.2
FIRST_COLUMNS, LATER_COLUMNS = 1024, 512  # azimuths over the front 180 degrees, over 360 degrees


@dataclass(frozen=True)
class Scan:
    """The contents of the four voxel files of a frame: classes 0-19, and three masks."""

    labels: UInt8[np.ndarray, "256 256 32"]
    invalid: Bool[np.ndarray, "256 256 32"]
    occluded: Bool[np.ndarray, "256 256 32"]
    hits: Bool[np.ndarray, "256 256 32"]


def scan_street(
    voxels: Voxels,
    places: Float[np.ndarray, "sweep 3"],
    rng: np.random.Generator,
) -> Scan:
    """Sweep from the grid's own pose (0, 0, 0), then from ``places`` (grid frame, metres).

    A voxel is labelled if it has samples of a surface that some sweep hits. It is invalid (unknown)
    if it has a surface that no sweep hits, or if the voxels hit hide it from every position. It is
    occluded, as in SemanticKITTI's files, unless it is empty and visible from the first position.
    """
    first, later = np.zeros(GRID_SHAPE, dtype=np.uint8), np.zeros(GRID_SHAPE, dtype=np.uint8)
    front = np.linspace(-math.pi / 2, math.pi / 2, FIRST_COLUMNS)
    turn = np.linspace(-math.pi, math.pi, LATER_COLUMNS, endpoint=False)
    sweeps = [(np.zeros(3), front, BEAMS, first)]
    for place in places:
        # the car's small rotations between scans move the beams
        nod = rng.uniform(0, BEAMS[0] - BEAMS[1])
        sweeps.append((place, turn + rng.uniform(0, turn[1] - turn[0]), BEAMS - nod, later))
    foliage = np.flatnonzero(voxels.leaves)
    for place, azimuths, elevations, seen in sweeps:
        solid = _look_through(voxels.classes, foliage, rng)
        mark_swept(solid, metres_to_voxels(place), azimuths, elevations, RANGE, seen)
    occupied = voxels.classes > 0
    hits = occupied & (first > 0)
    hit = occupied & ((first | later) > 0)
    labels = np.where(_grow(hit), voxels.scattered, 0)
    labels = np.where(hit & (labels == 0), voxels.classes, labels)
    for place, azimuths, _, seen in sweeps:
        mark_swept(labels, metres_to_voxels(place), azimuths[::2], ABOVE, RANGE, seen)
    invalid = (((first | later) == 0) | occupied) & (labels == 0)
    return Scan(labels, invalid, (first == 0) | (labels > 0) | invalid, hits)


def _look_through(
    classes: np.ndarray, foliage: np.ndarray, rng: np.random.Generator
) -> UInt8[np.ndarray, "256 256 32"]:
    """The grid without a random part of the foliage: beams pass between leaves, so the inside of
    trees is labelled over all sweeps."""
    solid = classes.copy()
    solid.reshape(-1)[foliage[rng.random(len(foliage), dtype=np.float32) < PASSING]] = 0
    return solid


def _grow(mask: np.ndarray) -> Bool[np.ndarray, "256 256 32"]:
    """A mask and the 26 neighbours of each of its voxels."""
    grown = mask.copy()
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        before = grown.copy()
        grown[tuple(ahead)] |= before[tuple(behind)]
        grown[tuple(behind)] |= before[tuple(ahead)]
    return grown
