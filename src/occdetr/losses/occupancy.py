"""The occupancy terms of the paper's loss (III-D): foreground dice, background BCE, MaskFormer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from occdetr.classes import IGNORE
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.losses.detection import focal_loss
from occdetr.losses.matcher import Match
from occdetr.structures import BackgroundLevel, OccupancyOutput, SceneTarget

SUPERSAMPLE = 2  # points per side of an object cell whose mean is the cell's true occupancy


class OccupancyCriterion(nn.Module):
    """Foreground dice, background occupancy BCE per level, MaskFormer focal and dice.

    ``mask_classes`` are the semantic ids of the mask head. ``background_voxels`` says which voxels
    the background answers for, beside those of the background classes: "unclaimed" also those of
    foreground classes that belong to no object (outside the view, hidden, too small); "background"
    none (the paper's partition to the letter); "all" every one.
    """

    def __init__(
        self,
        mask_classes: Sequence[int],
        foreground_classes: Sequence[int],
        background_voxels: Literal["unclaimed", "background", "all"],
        weight_foreground_dice: float,
        weight_background_bce: float,
        weight_mask_focal: float,
        weight_mask_dice: float,
        weight_mask_ce: float = 0.0,
        unknown_weight: float = 0.2,
    ) -> None:
        super().__init__()
        self.background_voxels = background_voxels
        self.weight_foreground_dice = weight_foreground_dice
        self.weight_background_bce = weight_background_bce
        self.weight_mask_focal = weight_mask_focal
        self.weight_mask_dice = weight_mask_dice
        self.weight_mask_ce = weight_mask_ce
        self.unknown_weight = unknown_weight
        index = torch.full((256,), -1, dtype=torch.long)
        index[list(mask_classes)] = torch.arange(len(mask_classes))
        self.register_buffer("mask_index", index, persistent=False)
        foreground = torch.zeros(256, dtype=torch.bool)
        foreground[list(foreground_classes)] = True
        self.register_buffer("is_foreground", foreground, persistent=False)

    def forward(
        self,
        output: OccupancyOutput,
        labels: UInt8[Tensor, "batch x y z"],
        targets: list[SceneTarget],
        matches: list[Match],
    ) -> dict[str, Tensor]:
        """The weighted terms; ``matches`` are those of the last decoder layer."""
        losses = {}
        owners = [object_grid(target) for target in targets]
        if output.foreground_logits is not None:
            value = self.foreground_dice(output, labels, owners, matches)
            losses["foreground_dice"] = self.weight_foreground_dice * value
        if output.voxels is not None:
            classes = self.background_classes(labels, torch.stack(owners))
            bce = [background_bce(level, classes, self.unknown_weight) for level in output.levels]
            losses["background_bce"] = self.weight_background_bce * torch.stack(bce).mean()
            losses |= self.mask_losses(output, classes)
        return losses

    def background_classes(
        self, labels: UInt8[Tensor, "batch x y z"], owners: Int[Tensor, "batch x y z"]
    ) -> UInt8[Tensor, "batch x y z"]:
        """``labels`` with every voxel emptied that the background does not answer for."""
        index = labels.long()
        if self.background_voxels == "all":
            foreign = torch.zeros_like(labels, dtype=torch.bool)
        elif self.background_voxels == "background":
            foreign = self.is_foreground[index]
        else:
            foreign = self.is_foreground[index] & (owners > 0)
        unanswered = (self.mask_index[index] < 0) & (labels != IGNORE)
        return labels.masked_fill(foreign | unanswered, 0)

    def foreground_dice(
        self,
        output: OccupancyOutput,
        labels: Tensor,
        owners: list[Tensor],
        matches: list[Match],
    ) -> Tensor:
        """Mean dice loss of the matched slots against the object resampled into their boxes."""
        logits, slots = output.foreground_logits, output.slots
        assert logits is not None and slots is not None
        terms = []
        for frame, (queries, objects) in enumerate(matches):
            pairs = (slots.query_indices[frame, :, None] == queries[None]).nonzero()
            slot, found = pairs[:, 0], objects[pairs[:, 1]]
            truth, known = resample_objects(
                owners[frame], labels[frame], found, slots.boxes3d[frame, slot], logits.shape[-1]
            )
            terms.append(dice_loss(logits[frame, slot].float().flatten(1), truth, known))
        losses = torch.cat(terms)
        return losses.sum() / max(len(losses), 1) + 0.0 * logits.sum()

    def mask_losses(
        self, output: OccupancyOutput, classes: UInt8[Tensor, "batch x y z"]
    ) -> dict[str, Tensor]:
        """Focal and dice over the kept voxels, per class; unknown voxels do not count.

        Beside the paper's two terms a cross-entropy over the classes of occupied voxels, which is
        what fusion's choice of the best class needs.
        """
        assert output.voxels is not None
        found = gather_cells(classes, output.voxels.coordinates)  # B, V
        known = (found != IGNORE).float()
        index = self.mask_index[found.long()]
        logits = output.mask_logits[-1].float()
        ids = torch.arange(logits.shape[1], device=logits.device)
        truth = (index[:, None] == ids[None, :, None]).float()  # B, C, V
        focal = (focal_loss(logits, truth) * known[:, None]).sum() / truth.sum().clamp(min=1)
        dice = dice_loss(logits, truth, known[:, None].expand_as(truth))
        present = (truth.sum(-1) > 0).float()
        losses = {
            "mask_focal": self.weight_mask_focal * focal,
            "mask_dice": self.weight_mask_dice * (dice * present).sum() / present.sum().clamp(min=1),
        }
        if self.weight_mask_ce:
            entropy = F.cross_entropy(logits, index, ignore_index=-1, reduction="sum")
            losses["mask_ce"] = self.weight_mask_ce * entropy / (index >= 0).sum().clamp(min=1)
        return losses


def object_grid(target: SceneTarget) -> Int[Tensor, "x y z"]:
    """For every voxel 1 + the object it belongs to, 0 where it belongs to none."""
    grid = torch.zeros(GRID_SHAPE, dtype=torch.int16, device=target.classes.device)
    x, y, z = target.voxels.long().unbind(1)
    grid[x, y, z] = (target.voxel_object + 1).to(torch.int16)
    return grid


def resample_objects(
    owner: Int[Tensor, "x y z"],
    labels: UInt8[Tensor, "x y z"],
    objects: Int[Tensor, " pair"],
    boxes3d: Float[Tensor, "pair 6"],
    cells: int,
) -> tuple[Float[Tensor, "pair cell"], Float[Tensor, "pair cell"]]:
    """Occupied and known shares of the cells of each box, for the object that belongs to it.

    The paper scales the local ground truth by linear interpolation; here the mean of
    ``SUPERSAMPLE``^3 points of each cell, so that thin parts are not lost between the points.
    """
    side = cells * SUPERSAMPLE
    steps = (torch.arange(side, device=boxes3d.device) + 0.5) / side - 0.5
    origin = boxes3d.new_tensor(GRID_ORIGIN)
    points = boxes3d[:, :3, None] + boxes3d[:, 3:, None] * steps  # M, 3, side
    index = ((points - origin[:, None]) / VOXEL_SIZE).floor().long()
    shape = torch.tensor(GRID_SHAPE, device=index.device)[:, None]
    inside = (index >= 0) & (index < shape)
    index = index.clamp(min=0).minimum(shape - 1)
    x, y, z = index[:, 0, :, None, None], index[:, 1, None, :, None], index[:, 2, None, None, :]
    valid = inside[:, 0, :, None, None] & inside[:, 1, None, :, None] & inside[:, 2, None, None, :]
    flat = (x * GRID_SHAPE[1] + y) * GRID_SHAPE[2] + z
    mine = (owner.view(-1)[flat] == objects[:, None, None, None] + 1) & valid
    known = (labels.view(-1)[flat] != IGNORE) & valid
    return _cell_means(mine, cells), _cell_means(known, cells)


def _cell_means(points: Bool[Tensor, "pair x y z"], cells: int) -> Float[Tensor, "pair cell"]:
    means = F.avg_pool3d(points.float()[:, None], SUPERSAMPLE)
    return means.reshape(len(points), cells**3)


def dice_loss(
    logits: Float[Tensor, "*n point"], truth: Float[Tensor, "*n point"], weight: Tensor
) -> Float[Tensor, " *n"]:
    """1 - dice coefficient (Milletari et al., 2016), over points of non-zero weight."""
    probability = logits.sigmoid()
    overlap = (weight * probability * truth).sum(-1)
    total = (weight * probability).sum(-1) + (weight * truth).sum(-1)
    return 1 - (2 * overlap + 1) / (total + 1)


def background_bce(
    level: BackgroundLevel, classes: UInt8[Tensor, "batch x y z"], unknown_weight: float
) -> Float[Tensor, ""]:
    """BCE of a level's candidates: a cell is occupied if any of its voxels is.

    Cells all of whose voxels are unknown count as empty with ``unknown_weight``, where a top-K
    follows: unpunished, they score high and take the places of occupied cells. Among the finest
    voxels, which nothing selects from, they do not count at all.
    """
    state = gather_cells(cell_states(classes, level.cell), level.coordinates)
    weight = (state != IGNORE).float()
    if level.cell > 1:
        weight = weight.clamp(min=unknown_weight)
    loss = F.binary_cross_entropy_with_logits(
        level.logits.float(), (state == 1).float(), reduction="none"
    )
    return (loss * weight).sum() / weight.sum().clamp(min=1)


def cell_states(
    classes: UInt8[Tensor, "batch x y z"], cell: int
) -> UInt8[Tensor, "batch cx cy cz"]:
    """1 where any voxel of a cell is occupied, else 0 where any is known, else 255."""
    occupied = (classes != 0) & (classes != IGNORE)
    rank = torch.where(occupied, 2, (classes == 0).to(torch.uint8))  # 2 occupied, 1 empty
    batch, x, y, z = classes.shape
    blocks = rank.view(batch, x // cell, cell, y // cell, cell, z // cell, cell)
    best = blocks.amax((2, 4, 6))
    return torch.where(best == 2, 1, torch.where(best == 1, 0, IGNORE)).to(torch.uint8)


def gather_cells(
    grid: UInt8[Tensor, "batch x y z"], coordinates: Int[Tensor, "batch cell 3"]
) -> UInt8[Tensor, "batch cell"]:
    """Values of ``grid`` at integer coordinates."""
    _, _, height, depth = grid.shape
    flat = (coordinates[..., 0] * height + coordinates[..., 1]) * depth + coordinates[..., 2]
    return grid.flatten(1).gather(1, flat)
