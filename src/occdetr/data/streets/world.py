"""The block of voxels a synthetic street is built in, and the materials it is built of.

The world reaches further than the label grid, so that the camera sees beyond it. It is aligned
with the label grid: ``crop_to_grid`` takes that part out without resampling. Positions are metres
in the grid frame (the LiDAR frame: x forward, y left, z up).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Shaped

from occdetr.classes import CLASS_NAMES
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE

WORLD_ORIGIN = (-6.0, -40.0, -2.0)
WORLD_SHAPE = (430, 400, 60)  # to 80 m ahead, 40 m to each side, 10 m above the sensor
SENSOR_HEIGHT = 1.73  # metres of KITTI's LiDAR above the road
OFFSET = tuple(
    round((grid - world) / VOXEL_SIZE)
    for grid, world in zip(GRID_ORIGIN, WORLD_ORIGIN, strict=True)
)

# How a material is painted in pictures (render.py).
PLAIN, ASPHALT, PAVING, PARKING, GRASS, GRAVEL, WALL, FENCE, LEAVES, BARK, SIGN = range(11)

CELL_X = WORLD_ORIGIN[0] + (np.arange(WORLD_SHAPE[0]) + 0.5) * VOXEL_SIZE
CELL_Y = WORLD_ORIGIN[1] + (np.arange(WORLD_SHAPE[1]) + 0.5) * VOXEL_SIZE


def crop_to_grid(world: Shaped[np.ndarray, "x y z"]) -> Shaped[np.ndarray, "256 256 32"]:
    """The part of a world array that is the label grid (a view)."""
    return world[tuple(slice(o, o + n) for o, n in zip(OFFSET, GRID_SHAPE, strict=True))]


class Material(NamedTuple):
    """What a voxel is made of; ``yaw`` (radians) is the direction its surfaces run along."""

    class_name: str
    color: tuple[float, float, float]
    kind: int = PLAIN
    yaw: float = 0.0


@dataclass(frozen=True)
class Part:
    """A box in an object's own frame (x ahead, y left, z up from the ground), in metres."""

    material: Material
    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]


class Palette:
    """The materials of a world by number, at most 255; number 0 is air.

    Once they are used up, a material gets the number of the last one of its class.
    """

    def __init__(self) -> None:
        self.classes = np.zeros(256, dtype=np.uint8)
        self.colors = np.zeros((256, 3), dtype=np.float32)
        self.kinds = np.zeros(256, dtype=np.uint8)
        self.yaws = np.zeros(256, dtype=np.float32)
        self._numbers: dict[Material, int] = {}

    def add(
        self, class_name: str, color: Iterable[float], kind: int = PLAIN, yaw: float = 0.0
    ) -> int:
        """The number of a material; the same material has one number."""
        red, green, blue = (min(max(float(value), 0.02), 0.98) for value in color)
        material = Material(class_name, (red, green, blue), kind, yaw)
        if material not in self._numbers:
            self._numbers[material] = self._new(material)
        return self._numbers[material]

    def _new(self, material: Material) -> int:
        class_id = CLASS_NAMES.index(material.class_name)
        number = len(self._numbers) + 1
        if number > 255:
            return int(np.flatnonzero(self.classes == class_id)[-1])
        self.classes[number], self.colors[number] = class_id, material.color
        self.kinds[number], self.yaws[number] = material.kind, material.yaw
        return number


@dataclass
class World:
    """A street under construction, and when finished all that scanning and rendering need.

    ``materials`` holds the material of each voxel, ``ground`` the index of each column's ground
    voxel, ``taken`` the columns that some object stands on.
    """

    palette: Palette = field(default_factory=Palette)
    materials: np.ndarray = field(default_factory=lambda: np.zeros(WORLD_SHAPE, dtype=np.uint8))
    ground: np.ndarray = field(default_factory=lambda: np.zeros(WORLD_SHAPE[:2], dtype=np.int16))
    ground_class: np.ndarray = field(
        default_factory=lambda: np.zeros(WORLD_SHAPE[:2], dtype=np.uint8)
    )
    taken: np.ndarray = field(default_factory=lambda: np.zeros(WORLD_SHAPE[:2], dtype=bool))

    @property
    def classes(self) -> Shaped[np.ndarray, "x y z"]:
        """Class id of every voxel."""
        return self.palette.classes[self.materials]

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """The column at a position, moved to the border if outside."""
        i = int(np.floor((x - WORLD_ORIGIN[0]) / VOXEL_SIZE))
        j = int(np.floor((y - WORLD_ORIGIN[1]) / VOXEL_SIZE))
        return min(max(i, 0), WORLD_SHAPE[0] - 1), min(max(j, 0), WORLD_SHAPE[1] - 1)

    def height(self, x: float, y: float) -> float:
        """Height of the ground at a position, metres."""
        return float(self.ground[self.cell(x, y)]) * VOXEL_SIZE + WORLD_ORIGIN[2]

    def window(
        self, x: float, y: float, yaw: float, radius: float
    ) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
        """The columns around a position, and their coordinates in its rotated frame."""
        (i0, j0), (i1, j1) = self.cell(x - radius, y - radius), self.cell(x + radius, y + radius)
        columns = (slice(i0, i1 + 1), slice(j0, j1 + 1))
        dx, dy = CELL_X[columns[0], None] - x, CELL_Y[None, columns[1]] - y
        cos, sin = np.cos(yaw), np.sin(yaw)
        return columns, cos * dx + sin * dy, cos * dy - sin * dx

    def claim(
        self,
        x: float,
        y: float,
        yaw: float,
        size: tuple[float, float],
        on: tuple[str, ...] | None = None,
    ) -> bool:
        """Take a rectangle (length, width) if it lies in the world, free, on the right ground."""
        if not (CELL_X[0] < x < CELL_X[-1] and CELL_Y[0] < y < CELL_Y[-1]):
            return False
        if on is not None and CLASS_NAMES[self.ground_class[self.cell(x, y)]] not in on:
            return False
        columns, ahead, left = self.window(x, y, yaw, 0.5 * float(np.hypot(*size)) + VOXEL_SIZE)
        footprint = (np.abs(ahead) <= size[0] / 2 + 0.1) & (np.abs(left) <= size[1] / 2 + 0.1)
        if (self.taken[columns] & footprint).any():
            return False
        self.taken[columns] |= footprint
        return True

    def paint(self, parts: Iterable[Part], x: float, y: float, yaw: float) -> None:
        """Put an object made of boxes on the ground, turned by ``yaw``; later parts win."""
        parts = list(parts)
        reach = max(abs(value) for part in parts for value in (*part.x, *part.y)) * 1.5
        i, j = self.cell(x, y)
        # on the middle of a column, so that a pole is one column wide wherever it stands
        columns, ahead, left = self.window(CELL_X[i], CELL_Y[j], yaw, reach + VOXEL_SIZE)
        base = int(self.ground[i, j]) + 1
        for part in parts:
            mask = _within(ahead, part.x) & _within(left, part.y)
            low, high = (int(np.ceil(value / VOXEL_SIZE - 0.5)) for value in part.z)
            levels = slice(max(base + low, 0), max(base + max(high, low + 1), 0))
            self.materials[*columns, levels][mask] = self.palette.add(*part.material)

    def scatter(
        self,
        material: int,
        center: tuple[float, float, float],
        radii: tuple[float, float],
        density: float,
        rng: np.random.Generator,
        cone: bool = False,
    ) -> None:
        """Fill an ellipsoid or a cone of foliage, porous, where there is air."""
        (x, y, z), (radius, half_height) = center, radii
        columns, ahead, left = self.window(x, y, 0.0, radius)
        heights = WORLD_ORIGIN[2] + (np.arange(WORLD_SHAPE[2]) + 0.5) * VOXEL_SIZE - z
        levels = np.flatnonzero(np.abs(heights) <= half_height)
        if not len(levels):
            return
        levels = slice(int(levels[0]), int(levels[-1]) + 1)
        up = heights[levels] / half_height
        span = ((1 - up) / 2) ** 2 if cone else 1 - up**2
        across = (ahead**2 + left**2) / radius**2
        chance = rng.random((*across.shape, len(up)), dtype=np.float32)
        inside = across[:, :, None] < span * (1 - 0.4 * chance)
        block = self.materials[*columns, levels]
        block[inside & (chance < density) & (block == 0)] = material

    def raise_columns(
        self, columns: Bool[np.ndarray, "x y"], top: np.ndarray | float, material: int
    ) -> None:
        """Fill chosen columns from the ground up to ``top`` metres above it."""
        i, j = np.nonzero(columns)
        base = self.ground[i, j] + 1
        levels = base + np.round(np.broadcast_to(top, columns.shape)[i, j] / VOXEL_SIZE)
        k = np.arange(WORLD_SHAPE[2])
        fill = (k >= base[:, None]) & (k < levels[:, None])
        block = self.materials[i, j]
        block[fill] = material
        self.materials[i, j] = block
        self.taken[i, j] = True


def _within(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Inside a range; one thinner than a voxel is widened to one, so that it cannot vanish."""
    middle, half = (limits[0] + limits[1]) / 2, max((limits[1] - limits[0]) / 2, 0.11)
    return np.abs(values - middle) <= half
