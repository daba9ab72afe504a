"""The occupancy terms of the paper's loss (III-D): foreground dice, background BCE, MaskFormer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from occdetr.classes import IGNORE, NUM_CLASSES, check_classes
from occdetr.errors import SHARE, check_range
from occdetr.losses.background import background_bce, gather_cells, state_pyramid
from occdetr.losses.detection import check_weights, focal_loss
from occdetr.losses.matcher import Match
from occdetr.losses.normalization import normalizer
from occdetr.losses.targets import ObjectTruth, SceneTruth, resample_objects
from occdetr.structures import OccupancyOutput

PAPER_TERMS = ("foreground_dice", "background_bce", "mask_focal", "mask_dice")
TERMS = (*PAPER_TERMS, "mask_ce", "scene_dice", "foreground_bce")


class OccupancyCriterion(nn.Module):
    """Foreground dice, background occupancy BCE per level, MaskFormer's focal and dice terms.

    ``mask_classes`` are the semantic ids of the mask head. ``background_voxels``: which voxels
    are the background's, beside those of the background classes: "unclaimed" also those of
    foreground classes that belong to no object (outside of the view, hidden, too small);
    "background" no others (the paper's partition); "all" every one. ``weights`` by term: the
    paper's four must be given, those beyond the paper (``mask_ce``, ``scene_dice``,
    ``foreground_bce``) are left out at 0. ``unknown_weight``: see ``background_bce``.
    ``objects``: how the truth of an object's cells is made. Raises InputError if a weight is
    missing, unknown or negative, or a class is unknown.
    """

    mask_index: Tensor

    def __init__(
        self,
        mask_classes: Sequence[int],
        foreground_classes: Sequence[int],
        background_voxels: Literal["unclaimed", "background", "all"],
        weights: Mapping[str, float],
        unknown_weight: float = 1.0,
        objects: ObjectTruth | None = None,
    ) -> None:
        super().__init__()
        self.background_voxels = background_voxels
        self.weights = check_weights("loss.occupancy", weights, TERMS, required=PAPER_TERMS)
        self.unknown_weight = unknown_weight
        self.objects = objects or ObjectTruth()
        check_range("loss.occupancy.unknown_weight", unknown_weight, SHARE)
        check_classes("mask_classes", mask_classes)
        check_classes("foreground_classes", foreground_classes)
        self.foreground_classes = list(foreground_classes)
        index = torch.full((256,), -1, dtype=torch.long)
        index[list(mask_classes)] = torch.arange(len(mask_classes))
        self.register_buffer("mask_index", index, persistent=False)
        self.mask_classes = list(mask_classes)
        kept = set(mask_classes)
        if background_voxels == "background":
            kept -= set(foreground_classes)
        self.emptied_classes = [c for c in range(1, NUM_CLASSES) if c not in kept]

    def forward(
        self, output: OccupancyOutput, truth: SceneTruth, matches: list[Match]
    ) -> dict[str, Tensor]:
        """The weighted terms; ``matches`` are those of the last decoder layer."""
        losses = {}
        if output.foreground_logits is not None:
            losses |= self.foreground_losses(output, truth, matches)
        if output.voxels is not None:
            classes = self.background_classes(truth)
            states = state_pyramid(classes, {level.cell for level in output.levels})
            bce = [
                background_bce(level, states[level.cell], self.unknown_weight)
                for level in output.levels
            ]
            losses["background_bce"] = self.weights["background_bce"] * torch.stack(bce).mean()
            losses |= self.mask_losses(output, classes)
        return losses

    def background_classes(self, truth: SceneTruth) -> UInt8[Tensor, "batch x y z"]:
        """The labels, with 0 at every voxel that is not the background's."""
        classes = truth.labels.clone()
        if self.background_voxels == "unclaimed":
            classes[truth.owner > 0] = 0
        for class_id in self.emptied_classes:
            classes[truth.labels == class_id] = 0
        return classes

    def foreground_losses(
        self, output: OccupancyOutput, truth: SceneTruth, matches: list[Match]
    ) -> dict[str, Tensor]:
        """Dice and BCE of the matched slots against the objects resampled into their boxes.

        ``ObjectTruth`` says whether boxes that miss their object count.
        """
        logits, slots = output.foreground_logits, output.slots
        assert logits is not None
        assert slots is not None
        dice, entropy = [], []
        for frame, (queries, objects) in enumerate(matches):
            pairs = (slots.query_indices[frame, :, None] == queries[None]).nonzero()
            slot, found = pairs[:, 0], objects[pairs[:, 1]]
            occupied, known = resample_objects(
                truth.owner[frame],
                truth.labels[frame],
                found,
                slots.boxes3d[frame, slot],
                logits.shape[-1],
                self.objects.resampling,
            )
            if self.objects.missed_boxes == "skip":
                hit = occupied.sum(1) > 0
                slot, occupied, known = slot[hit], occupied[hit], known[hit]
            predicted = logits[frame, slot].float().flatten(1)
            dice.append(dice_loss(predicted, occupied, known))
            cells = F.binary_cross_entropy_with_logits(predicted, occupied, reduction="none")
            entropy.append((cells * known).sum(1) / known.sum(1).clamp(min=1))
        count = normalizer(sum(len(term) for term in dice), logits.device)
        anchor = 0.0 * logits.sum()
        dice_term = self.weights["foreground_dice"] * torch.cat(dice).sum() / count
        losses = {"foreground_dice": dice_term + anchor}
        if weight := self.weights["foreground_bce"]:
            losses["foreground_bce"] = weight * torch.cat(entropy).sum() / count
        return losses

    def mask_losses(
        self, output: OccupancyOutput, classes: UInt8[Tensor, "batch x y z"]
    ) -> dict[str, Tensor]:
        """Focal and dice terms per class over the candidates; unknown voxels do not count.

        Beyond the paper: ``mask_ce``, the cross-entropy over the classes of occupied voxels, since
        fusion compares classes; and ``scene_dice``, the dice loss of occupancy times class, which
        is what fusion writes. Like IoU, it rewards filling a voxel whose probability is above half
        of the class's dice, which may be far below one half. In it, true voxels that are not among
        the candidates count as missed.
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
            if self.weights["scene_dice"]:
                count = torch.bincount(frame.flatten(), minlength=256)[self.mask_classes]
                written = occupancy[known].float().sigmoid() * known_logits.softmax(0)
                scene.append(mean_present(class_dice(written, index, count), count))
        focal, dice, entropy = _mean_terms(terms)
        named = {
            "mask_focal": self.weights["mask_focal"] * focal,
            "mask_dice": self.weights["mask_dice"] * dice,
        }
        if weight := self.weights["mask_ce"]:
            named["mask_ce"] = weight * entropy
        if weight := self.weights["scene_dice"]:
            named["scene_dice"] = (
                weight * torch.stack(scene).sum() / normalizer(len(scene), found.device)
            )
        if output.aux_mask_logits:
            named |= self._aux_mask_losses(output.aux_mask_logits, found)
        return named

    def _aux_mask_losses(
        self,
        layers: list[Float[Tensor, "batch class voxel"]],
        found: UInt8[Tensor, "batch voxel"],
    ) -> dict[str, Tensor]:
        """The paper's two terms, summed over the earlier layers of the mask head."""
        sums = {"aux_mask_focal": found.new_zeros((), dtype=torch.float32)}
        sums["aux_mask_dice"] = sums["aux_mask_focal"]
        for layer in layers:
            terms = []
            for own, logits in zip(found, layer, strict=True):
                known = own != IGNORE
                index = self.mask_index[own[known].long()]
                terms.append(self.mask_terms(logits[:, known].float(), index))
            focal, dice, _ = _mean_terms(terms)
            sums["aux_mask_focal"] = sums["aux_mask_focal"] + self.weights["mask_focal"] * focal
            sums["aux_mask_dice"] = sums["aux_mask_dice"] + self.weights["mask_dice"] * dice
        return sums

    @staticmethod
    def mask_terms(
        logits: Float[Tensor, "class voxel"], index: Int[Tensor, " voxel"]
    ) -> tuple[Float[Tensor, 3], Int[Tensor, 3]]:
        """Sums of focal, dice and cross-entropy over a frame's known voxels, and the numbers to
        divide them by: occupied voxels, classes present, occupied voxels. ``index`` is the class
        index of each voxel, -1 in empty ones.

        A voxel has at most one true class. So the focal loss is that of all-false classes,
        corrected at the true ones, and only ``logits`` has classes x voxels elements.
        """
        occupied = (index >= 0).nonzero().squeeze(1)
        own = index[occupied]
        at_truth = logits[own, occupied]
        correction = focal_loss(at_truth, 1.0) - focal_loss(at_truth, 0.0)
        focal = focal_loss(logits, 0.0).sum() + correction.sum()
        count = torch.bincount(own, minlength=len(logits))
        present = count > 0
        dice = class_dice(logits.sigmoid(), index, count)
        entropy = F.cross_entropy(logits[:, occupied].T, own, reduction="sum")
        number = torch.tensor(len(occupied), device=logits.device)
        losses = torch.stack([focal, (dice * present).sum(), entropy])
        return losses, torch.stack([number, present.sum(), number])


def _mean_terms(terms: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, ...]:
    """The sums of ``mask_terms`` over all frames, divided by their numbers."""
    losses = torch.stack([term for term, _ in terms]).sum(0)
    count = torch.stack([number for _, number in terms]).sum(0)
    return (losses / normalizer(count, losses.device)).unbind()


def class_dice(
    probability: Float[Tensor, "class voxel"],
    index: Int[Tensor, " voxel"],
    count: Int[Tensor, " class"],
) -> Float[Tensor, " class"]:
    """1 - dice coefficient of each class. ``index`` is the true class of each voxel, -1 in empty
    ones; ``count`` is the true number of voxels of each class."""
    occupied = (index >= 0).nonzero().squeeze(1)
    own = index[occupied]
    overlap = probability.new_zeros(len(probability)).index_add(0, own, probability[own, occupied])
    return 1 - (2 * overlap + 1) / (probability.sum(1) + count + 1)


def mean_present(terms: Float[Tensor, " class"], count: Int[Tensor, " class"]) -> Tensor:
    """The mean over the classes with a ``count`` above 0, or 0 if there is none."""
    present = count > 0
    return (terms * present).sum() / present.sum().clamp(min=1)


def dice_loss(
    logits: Float[Tensor, "*n point"], truth: Float[Tensor, "*n point"], weight: Tensor
) -> Float[Tensor, " *n"]:
    """1 - dice coefficient (Milletari et al., 2016), points weighted by ``weight``."""
    probability = logits.sigmoid()
    overlap = (weight * probability * truth).sum(-1)
    total = (weight * probability).sum(-1) + (weight * truth).sum(-1)
    return 1 - (2 * overlap + 1) / (total + 1)
