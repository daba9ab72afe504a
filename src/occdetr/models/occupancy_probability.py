"""The probability that a voxel is occupied: what the fusion compares with its thresholds."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from occdetr.geometry.voxels import GRID_SHAPE
from occdetr.models.fusion import Fusion, write_voxels
from occdetr.models.object_writer import axis_weights
from occdetr.structures import OccupancyOutput, Slots


def occupancy_probability(fusion: Fusion, output: OccupancyOutput) -> Float[Tensor, "batch x y z"]:
    """The largest of the probabilities that the background and the objects give to each voxel.

    Those of an object are its occupancy times its score; objects below the fusion's
    ``score_threshold`` are left out. Voxels that no part of the network has looked at, since a
    coarser cell that holds them was among the least probable, have 0.
    """
    if output.voxels is not None:
        probability = output.voxels.logits.float().sigmoid()
        grid = write_voxels(output.voxels.coordinates, probability)
    else:
        assert output.slots is not None
        grid = torch.zeros(len(output.slots.scores), *GRID_SHAPE, device=output.slots.scores.device)
    if output.slots is None or output.foreground_logits is None:
        return grid
    for frame, used in enumerate(output.slots.scores > fusion.score_threshold):
        for slot in used.nonzero()[:, 0].tolist():
            logits = output.foreground_logits[frame, slot]
            _raise_to_object(grid[frame], logits, output.slots, (frame, slot), fusion)
    return grid


def _raise_to_object(
    grid: Float[Tensor, "x y z"],
    logits: Float[Tensor, "n n n"],
    slots: Slots,
    place: tuple[int, int],
    fusion: Fusion,
) -> None:
    """Raise the voxels of the box of an object, in ``grid``, to the probability of the object."""
    box = slots.boxes3d[place]
    axes = [axis_weights(box, axis, logits.shape[-1], fusion.interpolation) for axis in range(3)]
    inside = [weights.any(1).nonzero()[:, 0] for weights in axes]
    if not all(map(len, inside)):
        return
    weights = [each[rows] for each, rows in zip(axes, inside, strict=True)]
    values = torch.einsum("xi,yj,zk,ijk->xyz", *weights, logits.float().sigmoid())
    part = grid[tuple(slice(int(rows[0]), int(rows[-1]) + 1) for rows in inside)]
    torch.maximum(part, values * slots.scores[place].float(), out=part)
