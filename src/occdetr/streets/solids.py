"""Materials, and solids with exact surfaces, of which synthetic streets consist.

Solids are in their object's frame (x ahead, y left, z up from the ground, metres). ``Scene``
transforms objects to the world frame and has all their solids as arrays for compiled code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

# Forms of solids.
#: ``half`` (x, y, z); the top is ``taper`` (x, y) times as wide as the bottom, and moved along x by
#: ``shift`` times half[0]: houses, roofs (taper 0 in y), car bodies and cabins, plates, bars.
BOX = 0
#: Upright: radii half[0] (x), half[1] (y), half height half[2]; the top is ``taper[0]`` times as
#: wide: trunks, poles, legs.
CYLINDER = 1
#: Lies along y: radius half[0], which is its half height half[2] too, half width half[1];
#: ``taper[0]`` is the radius of its hole over the outer one: wheels, rings.
WHEEL = 2
#: Radii ``half``: heads, tanks, domes.
ELLIPSOID = 3
#: Foliage fills these forms with leaves; ``density`` is the share of small cells that have any.
LEAFY_ELLIPSOID = 4
LEAFY_CONE = 5
LEAFY_BOX = 6

# Textures, in shade.py.
(PLAIN, ASPHALT, PAVING, PARKING, GRASS, GRAVEL, WALL, ROOF, FENCE, STONE, LEAVES, BARK, SIGN,
 METAL, PAINT, GLASS) = range(16)  # fmt: skip

Color = tuple[float, float, float]


class Material(NamedTuple):
    """SemanticKITTI class, colour (0-1) and texture of a surface."""

    class_name: str
    color: Color
    texture: int = PLAIN


@dataclass(frozen=True)
class Solid:
    """One solid of an object; ``yaw`` rotates it about its own vertical axis (radians)."""

    material: Material
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    form: int = BOX
    yaw: float = 0.0
    taper: tuple[float, float] = (1.0, 1.0)
    shift: float = 0.0
    density: float = 1.0


@dataclass(frozen=True)
class Shape:
    """An object: its footprint (length, width) in metres, which must be free, and its solids."""

    size: tuple[float, float]
    solids: list[Solid]


ShapeFunction = Callable[[np.random.Generator], Shape]


def box(
    material: Material,
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    taper: tuple[float, float] = (1.0, 1.0),
    shift: float = 0.0,
) -> Solid:
    """The box between limits on each axis."""
    center = (sum(x) / 2, sum(y) / 2, sum(z) / 2)
    half = ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2, (z[1] - z[0]) / 2)
    return Solid(material, center, half, taper=taper, shift=shift)
