"""The background's occupancy term (paper III-D): BCE of every level against coarser labels."""

from __future__ import annotations

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from occdetr.classes import IGNORE
from occdetr.losses.normalization import normalizer
from occdetr.structures import BackgroundLevel


def background_bce(
    level: BackgroundLevel, states: UInt8[Tensor, "batch cx cy cz"], unknown_weight: float
) -> Float[Tensor, ""]:
    """BCE of a level's candidates; ``states`` are those of ``state_pyramid`` for its cells.

    Unknown cells count as empty with ``unknown_weight`` on levels that a top-K follows: with 0
    (paper) they score high and take the places of occupied cells. Among the finest voxels, from
    which nothing is selected, they never count.
    """
    state = gather_cells(states, level.coordinates)
    weight = (state > 0).float()
    if level.cell > 1:
        weight = weight.clamp(min=unknown_weight)
    loss = F.binary_cross_entropy_with_logits(
        level.logits.float(), (state == 2).float(), reduction="none"
    )
    return (loss * weight).sum() / normalizer(weight.sum(), loss.device)


def state_pyramid(
    classes: UInt8[Tensor, "batch x y z"], cells: Iterable[int]
) -> dict[int, UInt8[Tensor, "batch _ _ _"]]:
    """The state of every cell, for each size of cell (a power of 2, in voxels).

    2: occupied (any of its voxels is); else 1: empty (any is known); else 0: unknown.
    """
    wanted = set(cells)
    state = 2 - (classes == 0).to(torch.uint8)
    state = state.masked_fill(classes == IGNORE, 0)
    pyramid, cell = {}, 1
    while True:
        if cell in wanted:
            pyramid[cell] = state
        if cell >= max(wanted):
            return pyramid
        for axis in (1, 2, 3):
            halves = state.unflatten(axis, (-1, 2)).unbind(axis + 1)
            state = torch.maximum(*halves)
        cell *= 2


def gather_cells(
    grid: UInt8[Tensor, "batch x y z"], coordinates: Int[Tensor, "batch cell 3"]
) -> UInt8[Tensor, "batch cell"]:
    """Values of ``grid`` at integer coordinates."""
    _, _, height, depth = grid.shape
    flat = (coordinates[..., 0] * height + coordinates[..., 1]) * depth + coordinates[..., 2]
    return grid.flatten(1).gather(1, flat)
