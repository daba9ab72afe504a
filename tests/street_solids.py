"""Small terrains and single solids for the tests of ray tracing and voxelisation."""

import numpy as np

from occdetr.streets.ground import Terrain
from occdetr.streets.scene import Solids
from occdetr.streets.solids import BOX, CYLINDER, WHEEL


def flat_terrain(depth=-5.0):
    heights = np.full((160, 160), depth, dtype=np.float32)
    return Terrain((-8.0, -8.0), heights, np.zeros((160, 160), dtype=np.uint8))


def one_solid(form, rng, density=1.0):
    yaw = rng.uniform(0, 6)
    half = rng.uniform(0.3, 1.5, 3)
    if form == WHEEL:
        half[2] = half[0]  # as solids.py has it
    taper = rng.uniform(0.2, 1.0, 2) if form in (BOX, CYLINDER, WHEEL) else np.ones(2)
    shift = rng.uniform(-0.5, 0.5) if form == BOX else 0.0
    row = [*rng.uniform(-1, 1, 3), np.cos(yaw), np.sin(yaw), *half, *taper, shift, density]
    return Solids(
        np.array([row]),
        np.array([form], dtype=np.uint8),
        np.zeros(1, dtype=np.int32),
        np.ones(1, dtype=np.uint8),
    )
