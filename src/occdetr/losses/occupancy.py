"""The occupancy terms of the paper's loss (III-D): foreground dice, background BCE, MaskFormer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from occdetr.classes import IGNORE, NUM_CLASSES
from occdetr.losses.detection import focal_loss
from occdetr.losses.matcher import Match
from occdetr.losses.targets import object_grid, resample_objects
from occdetr.structures import BackgroundLevel, OccupancyOutput, SceneTarget


class OccupancyCriterion(nn.Module):
    """Foreground dice, background occupancy BCE per level, MaskFormer focal and dice.

    ``mask_classes`` are the semantic ids of the mask head. ``background_voxels`` says which voxels
    the background answers for, beside those of the background classes: "unclaimed" also those of
    foreground classes that belong to no object (outside the view, hidden, too small); "background"
    none (the paper's partition to the letter); "all" every one.
    """

    mask_index: Tensor

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
        weight_scene_dice: float = 0.0,
        weight_foreground_bce: float = 0.0,
        unknown_weight: float = 1.0,
    ) -> None:
        super().__init__()
        self.background_voxels = background_voxels
        self.weight_foreground_dice = weight_foreground_dice
        self.weight_background_bce = weight_background_bce
        self.weight_mask_focal = weight_mask_focal
        self.weight_mask_dice = weight_mask_dice
        self.weight_mask_ce = weight_mask_ce
        self.weight_scene_dice = weight_scene_dice
        self.weight_foreground_bce = weight_foreground_bce
        self.unknown_weight = unknown_weight
        index = torch.full((256,), -1, dtype=torch.long)
        index[list(mask_classes)] = torch.arange(len(mask_classes))
        self.register_buffer("mask_index", index, persistent=False)
        self.mask_classes = list(mask_classes)
        kept = set(mask_classes)
        if background_voxels == "background":
            kept -= set(foreground_classes)
        self.emptied_classes = [c for c in range(1, NUM_CLASSES) if c not in kept]

    def forward(
        self,
        output: OccupancyOutput,
        labels: UInt8[Tensor, "batch x y z"],
        targets: list[SceneTarget],
        matches: list[Match],
    ) -> dict[str, Tensor]:
        """The weighted terms; ``matches`` are those of the last decoder layer."""
        losses = {}
        if output.foreground_logits is not None:
            losses |= self.foreground_losses(output, labels, targets, matches)
        if output.voxels is not None:
            classes = self.background_classes(labels, targets)
            states = state_pyramid(classes, {level.cell for level in output.levels})
            bce = [
                background_bce(level, states[level.cell], self.unknown_weight)
                for level in output.levels
            ]
            losses["background_bce"] = self.weight_background_bce * torch.stack(bce).mean()
            losses |= self.mask_losses(output, classes)
        return losses

    def background_classes(
        self, labels: UInt8[Tensor, "batch x y z"], targets: list[SceneTarget]
    ) -> UInt8[Tensor, "batch x y z"]:
        """``labels`` with every voxel emptied that the background does not answer for."""
        classes = labels.clone()
        if self.background_voxels == "unclaimed":
            for frame, target in enumerate(targets):
                x, y, z = target.voxels.long().unbind(1)
                classes[frame, x, y, z] = 0
        for class_id in self.emptied_classes:
            classes[labels == class_id] = 0
        return classes

    def foreground_losses(
        self,
        output: OccupancyOutput,
        labels: UInt8[Tensor, "batch x y z"],
        targets: list[SceneTarget],
        matches: list[Match],
    ) -> dict[str, Tensor]:
        """Dice and BCE of the matched slots against the object resampled into their boxes.

        A box that misses its object altogether teaches nothing about shapes: it does not count.
        """
        logits, slots = output.foreground_logits, output.slots
        assert logits is not None
        assert slots is not None
        dice, entropy = [], []
        for frame, (queries, objects) in enumerate(matches):
            pairs = (slots.query_indices[frame, :, None] == queries[None]).nonzero()
            slot, found = pairs[:, 0], objects[pairs[:, 1]]
            owner, boxes = object_grid(targets[frame]), slots.boxes3d[frame, slot]
            truth, known = resample_objects(owner, labels[frame], found, boxes, logits.shape[-1])
            hit = truth.sum(1) > 0
            truth, known = truth[hit], known[hit]
            predicted = logits[frame, slot[hit]].float().flatten(1)
            dice.append(dice_loss(predicted, truth, known))
            cells = F.binary_cross_entropy_with_logits(predicted, truth, reduction="none")
            entropy.append((cells * known).sum(1) / known.sum(1).clamp(min=1))
        count, anchor = max(sum(len(term) for term in dice), 1), 0.0 * logits.sum()
        losses = {
            "foreground_dice": self.weight_foreground_dice * torch.cat(dice).sum() / count + anchor
        }
        if self.weight_foreground_bce:
            bce = self.weight_foreground_bce * torch.cat(entropy).sum() / count
            losses["foreground_bce"] = bce
        return losses

    def mask_losses(
        self, output: OccupancyOutput, classes: UInt8[Tensor, "batch x y z"]
    ) -> dict[str, Tensor]:
        """Focal and dice over the kept voxels, per class; unknown voxels do not count.

        Beside the paper's two terms a cross-entropy over the classes of occupied voxels, which is
        what fusion's choice of the best class needs, and the dice of what fusion writes, occupancy
        times class. That one rewards a voxel of a class whose place is hard to tell (a facade, a
        hedge) where its chance is above half of that class's dice, not half: so does IoU. True
        voxels that are no candidates count as missed there.
        """
        assert output.voxels is not None
        assert output.mask_logits is not None
        found = gather_cells(classes, output.voxels.coordinates)  # B, V
        terms, scene = [], []
        for frame, own, occupancy, logits in zip(
            classes, found, output.voxels.logits, output.mask_logits, strict=True
        ):
            known = own != IGNORE
            known_logits, index = logits[:, known].float(), self.mask_index[own[known].long()]
            terms.append(self.mask_terms(known_logits, index))
            if self.weight_scene_dice:
                count = torch.bincount(frame.flatten(), minlength=256)[self.mask_classes]
                written = occupancy[known].float().sigmoid() * known_logits.softmax(0)
                scene.append(mean_present(class_dice(written, index, count), count))
        losses = torch.stack([term for term, _ in terms]).sum(0)
        count = torch.stack([number for _, number in terms]).sum(0).clamp(min=1)
        focal, dice, entropy = (losses / count).unbind()
        named = {
            "mask_focal": self.weight_mask_focal * focal,
            "mask_dice": self.weight_mask_dice * dice,
        }
        if self.weight_mask_ce:
            named["mask_ce"] = self.weight_mask_ce * entropy
        if self.weight_scene_dice:
            named["scene_dice"] = self.weight_scene_dice * torch.stack(scene).mean()
        return named

    @staticmethod
    def mask_terms(
        logits: Float[Tensor, "class voxel"], index: Int[Tensor, " voxel"]
    ) -> tuple[Float[Tensor, 3], Int[Tensor, 3]]:
        """Sums of focal, dice and cross-entropy of a frame's known voxels, and what they count:
        occupied voxels, classes present, occupied voxels. ``index`` is -1 in empty voxels.

        A voxel has one true class at most: the focal loss is that of false classes everywhere, put
        right at the true ones, so that nothing but ``logits`` is as large as classes x voxels.
        """
        occupied = (index >= 0).nonzero().squeeze(1)
        own = index[occupied]
        at_truth = logits[own, occupied]
        put_right = focal_loss(at_truth, 1.0) - focal_loss(at_truth, 0.0)
        focal = focal_loss(logits, 0.0).sum() + put_right.sum()
        count = torch.bincount(own, minlength=len(logits))
        present = count > 0
        dice = class_dice(logits.sigmoid(), index, count)
        entropy = F.cross_entropy(logits[:, occupied].T, own, reduction="sum")
        number = torch.tensor(len(occupied), device=logits.device)
        losses = torch.stack([focal, (dice * present).sum(), entropy])
        return losses, torch.stack([number, present.sum(), number])


def class_dice(
    probability: Float[Tensor, "class voxel"],
    index: Int[Tensor, " voxel"],
    count: Int[Tensor, " class"],
) -> Float[Tensor, " class"]:
    """1 - dice coefficient of each class; ``index`` is the true class, -1 in empty voxels, and
    ``count`` how many voxels each class truly has."""
    occupied = (index >= 0).nonzero().squeeze(1)
    own = index[occupied]
    overlap = probability.new_zeros(len(probability)).index_add(0, own, probability[own, occupied])
    return 1 - (2 * overlap + 1) / (probability.sum(1) + count + 1)


def mean_present(terms: Float[Tensor, " class"], count: Int[Tensor, " class"]) -> Tensor:
    """The mean over the classes that occur, 0 if none does."""
    present = count > 0
    return (terms * present).sum() / present.sum().clamp(min=1)


def dice_loss(
    logits: Float[Tensor, "*n point"], truth: Float[Tensor, "*n point"], weight: Tensor
) -> Float[Tensor, " *n"]:
    """1 - dice coefficient (Milletari et al., 2016), over points of non-zero weight."""
    probability = logits.sigmoid()
    overlap = (weight * probability * truth).sum(-1)
    total = (weight * probability).sum(-1) + (weight * truth).sum(-1)
    return 1 - (2 * overlap + 1) / (total + 1)


def background_bce(
    level: BackgroundLevel, states: UInt8[Tensor, "batch cx cy cz"], unknown_weight: float
) -> Float[Tensor, ""]:
    """BCE of a level's candidates; ``states`` as ``state_pyramid`` gives them for its cells.

    Unknown cells count as empty with ``unknown_weight``, where a top-K follows: unpunished, they
    score high and take the places of occupied cells. Among the finest voxels, which nothing
    selects from, they do not count at all.
    """
    state = gather_cells(states, level.coordinates)
    weight = (state > 0).float()
    if level.cell > 1:
        weight = weight.clamp(min=unknown_weight)
    loss = F.binary_cross_entropy_with_logits(
        level.logits.float(), (state == 2).float(), reduction="none"
    )
    return (loss * weight).sum() / weight.sum().clamp(min=1)


def state_pyramid(
    classes: UInt8[Tensor, "batch x y z"], cells: Iterable[int]
) -> dict[int, UInt8[Tensor, "batch _ _ _"]]:
    """For each size of cell (a power of 2, in voxels) the state of every cell.

    2 occupied, if any of its voxels is; else 1 empty, if any is known; else 0 unknown.
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
