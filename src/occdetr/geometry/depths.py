"""Depth as a position on a logarithmic scale, the same for any camera."""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

#: The scale's ends, in units of focal length / image height: 1.9 and 53 m for KITTI's camera.
NEAREST, FARTHEST = 1.0, 28.0


def depth_unit(
    projection: Float[Tensor, "batch 3 4"], image_size: tuple[int, int]
) -> Float[Tensor, " batch"]:
    """Metres of one unit of depth: focal length / image height."""
    return projection[:, 1, 1] / image_size[0]


def depth_position(
    depth: Float[Tensor, "batch ..."], unit: Float[Tensor, " batch"], num_intervals: int
) -> Float[Tensor, "batch ..."]:
    """Depth (metres) counted in intervals of equal ratio: 0 at the nearest end of the scale,
    ``num_intervals`` at the farthest, below and above beyond them."""
    unit = unit.reshape(-1, *[1] * (depth.dim() - 1))
    ratio = (depth / (unit * NEAREST)).clamp(min=1e-3).log() / math.log(FARTHEST / NEAREST)
    return num_intervals * ratio
