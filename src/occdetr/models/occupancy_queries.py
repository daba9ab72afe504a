"""The values inside the occupancy decoder: its queries, the image that they see, its output."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from occdetr.geometry.camera import Camera
from occdetr.models.line_of_sight import LevelValues
from occdetr.structures import BackgroundLevel, Memory


@dataclass
class ObjectQueries:
    """What the decoder gets for each object slot.

    ``query_feat``: the detector's feature, ``class_scores``: its scores after the sigmoid,
    ``boxes3d``: the enlarged box in the grid frame, metres. Slots that are not ``used`` are
    decoded, but no query attends to them.
    """

    query_feat: Float[Tensor, "batch slot dim"]
    class_scores: Float[Tensor, "batch slot class"]
    boxes3d: Float[Tensor, "batch slot 6"]
    used: Bool[Tensor, "batch slot"]


@dataclass
class Background:
    """Output of the sparse half.

    ``levels``: the candidates of every level, which the occupancy loss supervises. ``finest``: the
    voxels of the full grid. ``features``: one per kept cell, which the mask head attends to.
    ``embedding``: one per finest voxel, which the mask head classifies.
    """

    levels: list[BackgroundLevel]
    finest: BackgroundLevel
    features: Float[Tensor, "batch kept dim"]
    embedding: Float[Tensor, "batch voxel voxel_dim"]


@dataclass
class Queries:
    """The 3D queries of one level: the objects' first, then the background's.

    ``boxes`` are in the grid frame, metres. ``cells`` are the background's boxes as integer
    coordinates on their level's grid.
    """

    features: Float[Tensor, "batch query dim"]
    boxes: Float[Tensor, "batch query 6"]
    cells: Int[Tensor, "batch sparse 3"]

    @property
    def num_dense(self) -> int:
        """How many belong to objects."""
        return self.boxes.shape[1] - self.cells.shape[1]


@dataclass
class ImageView:
    """What the queries look at: the memory, through a camera. ``maps``: see ``LineOfSight``."""

    memory: Memory
    camera: Camera
    maps: list[LevelValues] | None


def key_mask(
    used: Bool[Tensor, "batch slot"], dense: int, total: int
) -> Bool[Tensor, "batch query"]:
    """The queries that may be attended to: the children of used slots and all of the background.

    Without a background the first query stays visible, so that attention is always defined.
    """
    batch, slots = used.shape
    children = used.repeat_interleave(dense // slots, dim=1) if slots else used
    rest = torch.ones(batch, total - dense, dtype=torch.bool, device=used.device)
    first = torch.arange(total, device=used.device) == 0
    mask = torch.cat([children, rest], dim=1)
    return mask | (first & (dense == total))
