"""Background voxels and foreground objects -> the full semantic grid (paper III-C, last step)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Int, Num
from torch import Tensor, nn

from occdetr.classes import check_classes
from occdetr.errors import SHARE, check_ranges
from occdetr.geometry.voxels import GRID_SHAPE
from occdetr.models.object_writer import Interpolation, write_objects
from occdetr.structures import OccupancyOutput


class Fusion(nn.Module):
    """Writes background voxels by their class, then the objects over them, higher scores last.

    ``mask_classes``: the semantic id of each class of the mask head. A background voxel is written
    if its occupancy exceeds ``background_threshold``. An object is written if its score exceeds
    ``score_threshold``, in the voxels where its occupancy exceeds ``foreground_threshold``.
    ``interpolation``: a voxel's occupancy is interpolated "trilinear"-ly between the object's
    cells, or it is that of the cell which holds its centre ("nearest": cells are mapped as boxes).
    The grid has the type of the buffer ``mask_classes``: bytes, unless an export changes it.
    Raises InputError on unknown classes and on values out of range.
    """

    mask_classes: Tensor

    def __init__(
        self,
        mask_classes: Sequence[int],
        background_threshold: float,
        foreground_threshold: float,
        score_threshold: float,
        interpolation: Interpolation = "trilinear",
    ) -> None:
        super().__init__()
        check_classes("mask_classes", mask_classes)
        self.classes = list(mask_classes)
        classes = torch.tensor(self.classes, dtype=torch.uint8)
        self.register_buffer("mask_classes", classes, persistent=False)
        self.background_threshold = background_threshold
        self.foreground_threshold = foreground_threshold
        self.score_threshold = score_threshold
        thresholds = ("background_threshold", "foreground_threshold", "score_threshold")
        check_ranges("model.fusion", self, **dict.fromkeys(thresholds, SHARE))
        self.interpolation: Interpolation = interpolation

    def forward(self, output: OccupancyOutput) -> Num[Tensor, "batch x y z"]:
        grid = None
        if output.voxels is not None and output.mask_logits is not None:
            occupied = output.voxels.logits.sigmoid() > self.background_threshold
            classes = self.mask_classes[output.mask_logits.max(1).indices]  # faster than argmax
            grid = write_voxels(output.voxels.coordinates, torch.where(occupied, classes, 0))
        if output.slots is None or output.foreground_logits is None:
            assert grid is not None
            return grid
        slots = output.slots
        if grid is None:
            batch = len(slots.scores)
            grid = self.mask_classes.new_zeros(batch, *GRID_SHAPE)
        return write_objects(
            grid,
            output.foreground_logits,
            slots.boxes3d,
            slots.classes,
            slots.scores > self.score_threshold,
            self.foreground_threshold,
            self.interpolation,
        )


def write_voxels(
    coordinates: Int[Tensor, "batch voxel 3"], classes: Num[Tensor, "batch voxel"]
) -> Num[Tensor, "batch x y z"]:
    """Scatter classes into an empty grid; coordinates are distinct voxels of the full grid."""
    _, height, depth = GRID_SHAPE
    flat = (coordinates[..., 0] * height + coordinates[..., 1]) * depth + coordinates[..., 2]
    grid = classes.new_zeros(len(classes), GRID_SHAPE[0] * height * depth)
    return grid.scatter(1, flat, classes).view(-1, *GRID_SHAPE)
