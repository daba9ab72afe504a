"""Background voxels and foreground objects -> the full semantic grid (paper III-C, last step)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from occdetr.classes import check_classes
from occdetr.errors import SHARE, check_ranges
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.structures import OccupancyOutput

Interpolation = Literal["trilinear", "nearest"]


class Fusion(nn.Module):
    """Writes background voxels by their class, then the objects over them, higher scores last.

    ``mask_classes``: the semantic id of each class of the mask head. A background voxel is written
    if its occupancy exceeds ``background_threshold``. An object is written if its score exceeds
    ``score_threshold``, in the voxels where its occupancy exceeds ``foreground_threshold``.
    ``interpolation``: a voxel's occupancy is interpolated "trilinear"-ly between the object's
    cells, or it is that of the cell which holds its centre ("nearest": cells are mapped as boxes).
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

    def forward(self, output: OccupancyOutput) -> UInt8[Tensor, "batch x y z"]:
        grid = None
        if output.voxels is not None and output.mask_logits is not None:
            occupied = output.voxels.logits.sigmoid() > self.background_threshold
            classes = self.mask_classes[output.mask_logits.argmax(1)]
            grid = write_voxels(output.voxels.coordinates, torch.where(occupied, classes, 0))
        if output.slots is None or output.foreground_logits is None:
            assert grid is not None
            return grid
        slots = output.slots
        if grid is None:
            batch = len(slots.scores)
            grid = torch.zeros(batch, *GRID_SHAPE, dtype=torch.uint8, device=slots.scores.device)
        probability = output.foreground_logits.sigmoid()
        probability = probability * (slots.scores > self.score_threshold)[..., None, None, None]
        classes = slots.classes.to(torch.uint8)
        for index in reversed(range(slots.scores.shape[1])):  # slots come best first
            inside = resample(probability[:, index], slots.boxes3d[:, index], self.interpolation)
            label = classes[:, index, None, None, None]
            grid = torch.where(inside > self.foreground_threshold, label, grid)
        return grid


def write_voxels(
    coordinates: Int[Tensor, "batch voxel 3"], classes: UInt8[Tensor, "batch voxel"]
) -> UInt8[Tensor, "batch x y z"]:
    """Scatter classes into an empty grid; coordinates are distinct voxels of the full grid."""
    _, height, depth = GRID_SHAPE
    flat = (coordinates[..., 0] * height + coordinates[..., 1]) * depth + coordinates[..., 2]
    grid = torch.zeros(
        len(classes), GRID_SHAPE[0] * height * depth, dtype=torch.uint8, device=classes.device
    )
    return grid.scatter(1, flat, classes).view(-1, *GRID_SHAPE)


def resample(
    occupancy: Float[Tensor, "batch n n n"],
    boxes3d: Float[Tensor, "batch 6"],
    interpolation: Interpolation = "trilinear",
) -> Float[Tensor, "batch x y z"]:
    """Values of small grids at every voxel centre of the full grid; zero outside of their boxes.

    Interpolation is separable, so it is one small matrix product per axis.
    """
    place = _nearest_weights if interpolation == "nearest" else _linear_weights
    weights = [place(boxes3d, axis, occupancy.shape[-1]) for axis in range(3)]
    x = torch.einsum("bijk,bzk->bijz", occupancy, weights[2])
    x = torch.einsum("bijz,byj->biyz", x, weights[1])
    return torch.einsum("biyz,bxi->bxyz", x, weights[0])


def _linear_weights(boxes3d: Tensor, axis: int, cells: int) -> Float[Tensor, "batch voxel cell"]:
    """Linear interpolation weights of the voxels of one axis over the cells of a box.

    Beyond the centre of the outermost cell its value holds to the face of the box.
    """
    place, inside = _places(boxes3d, axis)
    position = (place * cells - 0.5).clamp(0, cells - 1)
    cell = torch.arange(cells, device=boxes3d.device, dtype=boxes3d.dtype)
    weight = (1 - (position[..., None] - cell).abs()).clamp(min=0)
    return weight * inside[..., None]


def _nearest_weights(boxes3d: Tensor, axis: int, cells: int) -> Float[Tensor, "batch voxel cell"]:
    """1 for the cell that holds a voxel's centre."""
    place, inside = _places(boxes3d, axis)
    position = (place * cells).floor().clamp(0, cells - 1)
    cell = torch.arange(cells, device=boxes3d.device, dtype=boxes3d.dtype)
    return (position[..., None] == cell).to(boxes3d.dtype) * inside[..., None]


def _places(
    boxes3d: Tensor, axis: int
) -> tuple[Float[Tensor, "batch voxel"], Bool[Tensor, "batch voxel"]]:
    """The voxel centres of one axis, 0 to 1 inside a box, and which are inside."""
    index = torch.arange(GRID_SHAPE[axis], device=boxes3d.device, dtype=boxes3d.dtype)
    center = GRID_ORIGIN[axis] + (index + 0.5) * VOXEL_SIZE
    size = boxes3d[:, 3 + axis, None].clamp(min=1e-3)
    place = (center[None] - boxes3d[:, axis, None]) / size + 0.5
    return place, (place >= 0) & (place <= 1)
