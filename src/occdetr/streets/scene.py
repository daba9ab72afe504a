"""The objects of a street, and all their solids at one time as arrays for compiled code.

Positions are metres in the world frame: the LiDAR frame of the world's first scan (x forward, y
left, z up).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int32, UInt8

from occdetr.classes import CLASS_NAMES
from occdetr.streets.ground import CELL, SURFACES, Plan, Terrain
from occdetr.streets.layout import Layout
from occdetr.streets.solids import Color, Material, Shape, Solid

CLAIM_CELL = 0.2  # metres


class Solids(NamedTuple):
    """All solids at one time. Rows of ``geometry``: centre (3), cosine and sine of the yaw, half
    sizes (3), taper (2), shift, density."""

    geometry: Float[np.ndarray, "solid 12"]
    forms: UInt8[np.ndarray, " solid"]
    materials: Int32[np.ndarray, " solid"]
    classes: UInt8[np.ndarray, " solid"]


@dataclass(frozen=True)
class Motion:
    """The motion of an object on the road: initial position (``along``, ``lateral``), ``yaw``
    relative to the road's direction, ``speed`` along the road and ``drift`` sideways (m/s)."""

    along: float
    lateral: float
    yaw: float = 0.0
    speed: float = 0.0
    drift: float = 0.0


@dataclass(frozen=True)
class _Object:
    rows: np.ndarray  # (solid, 12) in the object's frame
    forms: np.ndarray
    materials: np.ndarray
    place: tuple[float, float, float]  # x, y, yaw
    motion: Motion | None


class Palette:
    """The numbered materials of a world; equal materials share a number.

    The first ones are those of the ground's ``SURFACES``, in this order.
    """

    def __init__(self) -> None:
        self._numbers: dict[Material, int] = {}

    def add(self, material: Material) -> int:
        return self._numbers.setdefault(material, len(self._numbers))

    @property
    def classes(self) -> UInt8[np.ndarray, " material"]:
        return np.array([CLASS_NAMES.index(m.class_name) for m in self._numbers], dtype=np.uint8)

    @property
    def colors(self) -> Float[np.ndarray, "material 3"]:
        return np.clip(np.array([m.color for m in self._numbers], dtype=np.float64), 0.02, 0.98)

    @property
    def textures(self) -> UInt8[np.ndarray, " material"]:
        return np.array([m.texture for m in self._numbers], dtype=np.uint8)


@dataclass
class Scene:
    """A street: its plan, its ground and its objects."""

    layout: Layout
    plan: Plan
    terrain: Terrain
    palette: Palette = field(default_factory=Palette)
    objects: list[_Object] = field(default_factory=list)

    def __post_init__(self) -> None:
        width, depth = self.terrain.heights.shape
        step = round(CLAIM_CELL / CELL)
        self.taken = np.zeros((width // step, depth // step), dtype=bool)

    def lay(self, colors: dict[str, tuple[Color, int]]) -> None:
        """Set colour and texture of every surface of the ground, before any object is added."""
        for name in SURFACES:
            self.palette.add(Material(name, *colors[name]))

    def put(
        self, solids: Iterable[Solid], x: float, y: float, yaw: float, motion: Motion | None = None
    ) -> None:
        """Add an object on the ground at a fixed position, or with a motion."""
        solids = list(solids)
        rows = [
            (*s.center, np.cos(s.yaw), np.sin(s.yaw), *s.half, *s.taper, s.shift, s.density)
            for s in solids
        ]
        materials = [self.palette.add(s.material) for s in solids]
        self.objects.append(
            _Object(
                np.array(rows, dtype=np.float64),
                np.array([s.form for s in solids], dtype=np.uint8),
                np.array(materials, dtype=np.int32),
                (x, y, yaw),
                motion,
            )
        )

    def place(self, motion: Motion, time: float = 0.0) -> tuple[float, float, float]:
        """(x, y, yaw) of a motion after ``time`` seconds."""
        along = motion.along + motion.speed * time
        x, y, yaw = self.layout.road.point(along, motion.lateral + motion.drift * time)
        return x, y, yaw + motion.yaw

    def try_put(
        self,
        shape: Shape,
        motion: Motion,
        on: tuple[str, ...] | None = None,
        margin: float = 0.3,
    ) -> bool:
        """Add a shape at road coordinates if its footprint is free and on the right surface."""
        x, y, yaw = self.place(motion)
        size = (shape.size[0] + margin, shape.size[1] + margin)
        if not self.claim(x, y, yaw, size, on):
            return False
        moves = motion.speed != 0.0 or motion.drift != 0.0
        self.put(shape.solids, x, y, yaw, motion if moves else None)
        return True

    def claim(
        self,
        x: float,
        y: float,
        yaw: float,
        size: tuple[float, float],
        on: tuple[str, ...] | None = None,
    ) -> bool:
        """Mark a rectangle (length, width) as taken if it is inside the world, free and on the
        right surface; returns whether it is."""
        (x0, y0), (nx, ny) = self.terrain.origin, self.taken.shape
        i, j = (x - x0) / CLAIM_CELL, (y - y0) / CLAIM_CELL
        if not (1 <= i < nx - 1 and 1 <= j < ny - 1):
            return False
        if on is not None and self.terrain.surface(x, y) not in on:
            return False
        reach = 0.5 * float(np.hypot(*size)) / CLAIM_CELL + 1
        rows = slice(max(int(i - reach), 0), min(int(i + reach) + 2, nx))
        columns = slice(max(int(j - reach), 0), min(int(j + reach) + 2, ny))
        dx = (np.arange(rows.start, rows.stop)[:, None] + 0.5 - i) * CLAIM_CELL
        dy = (np.arange(columns.start, columns.stop)[None] + 0.5 - j) * CLAIM_CELL
        cos, sin = np.cos(yaw), np.sin(yaw)
        footprint = np.abs(cos * dx + sin * dy) <= size[0] / 2 + CLAIM_CELL / 2
        footprint &= np.abs(cos * dy - sin * dx) <= size[1] / 2 + CLAIM_CELL / 2
        if (self.taken[rows, columns] & footprint).any():
            return False
        self.taken[rows, columns] |= footprint
        return True

    def solids_at(self, time: float) -> Solids:
        """All solids in the world frame after ``time`` seconds."""
        rows = np.concatenate([self._posed(thing, time) for thing in self.objects])
        materials = np.concatenate([thing.materials for thing in self.objects])
        forms = np.concatenate([thing.forms for thing in self.objects])
        return Solids(rows, forms, materials, self.palette.classes[materials])

    def _posed(self, thing: _Object, time: float) -> np.ndarray:
        x, y, yaw = thing.place if thing.motion is None else self.place(thing.motion, time)
        cos, sin = np.cos(yaw), np.sin(yaw)
        rows = thing.rows.copy()
        rows[:, 0] = x + cos * thing.rows[:, 0] - sin * thing.rows[:, 1]
        rows[:, 1] = y + sin * thing.rows[:, 0] + cos * thing.rows[:, 1]
        rows[:, 2] += self.terrain.height(x, y)
        rows[:, 3] = cos * thing.rows[:, 3] - sin * thing.rows[:, 4]
        rows[:, 4] = sin * thing.rows[:, 3] + cos * thing.rows[:, 4]
        return rows
