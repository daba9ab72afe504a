"""A grid of known content for the tests of drawing."""

import numpy as np

from occdetr.classes import CLASS_NAMES
from occdetr.geometry.voxels import GRID_SHAPE

SIZE = (120, 160)


def car_and_vegetation() -> np.ndarray:
    """A block of car to the left, one of vegetation to the right."""
    grid = np.zeros(GRID_SHAPE, dtype=np.uint8)
    grid[60:80, 165:180, 2:14] = CLASS_NAMES.index("car")
    grid[60:80, 80:95, 2:14] = CLASS_NAMES.index("vegetation")
    return grid
