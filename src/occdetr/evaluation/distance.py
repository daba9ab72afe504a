"""Bands of distance: how far ahead of the car a voxel or an object is.

Distance is the x coordinate in the grid frame, in metres ahead of the LiDAR: of a voxel's centre,
or of the centre of an object's box. It is the quantity that a single image determines least, and
objects are sorted by it. The bands are disjoint and cover the whole grid. (The nested volumes of
SSCBench and VoxFormer, 12.8 x 12.8, 25.6 x 25.6 and 51.2 x 51.2 m, also leave out what is near
but to the side.)
"""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float, Int
from torch import Tensor

from occdetr.geometry.voxels import VOXEL_SIZE

#: Borders between the bands, in metres.
BORDERS = (12.8, 25.6)
BANDS = ("0-12.8 m", "12.8-25.6 m", "25.6-51.2 m")


def band_slices() -> list[slice]:
    """The slice of voxel indices along x of each band; the last band reaches to the grid's end."""
    edges = [0, *(round(border / VOXEL_SIZE) for border in BORDERS), None]
    return [slice(start, end) for start, end in itertools.pairwise(edges)]


def band_of(x: Float[Tensor, " point"]) -> Int[Tensor, " point"]:
    """Index of the band of points ``x`` metres ahead; a border belongs to the farther band."""
    borders = torch.tensor(BORDERS, dtype=x.dtype, device=x.device)
    return torch.bucketize(x.contiguous(), borders, right=True)
