"""The occupancy terms of the paper's loss (III-D): foreground dice, background BCE, MaskFormer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from occdetr.classes import IGNORE, NUM_CLASSES, check_classes
from occdetr.errors import SHARE, check_range
from occdetr.losses.background import background_bce, gather_cells, state_pyramid
from occdetr.losses.detection import check_weights
from occdetr.losses.mask_sums import EMPTY, UNKNOWN, MaskSums, mask_sums
from occdetr.losses.matcher import Match
from occdetr.losses.normalization import normalizer
from occdetr.losses.targets import ObjectTruth, SceneTruth, resample_objects
from occdetr.structures import OccupancyOutput

PAPER_TERMS = ("foreground_dice", "background_bce", "mask_focal", "mask_dice")
TERMS = (*PAPER_TERMS, "mask_ce", "scene_dice", "sem_scal", "geo_scal", "foreground_bce")


class OccupancyCriterion(nn.Module):
    """Foreground dice, background occupancy BCE per level, MaskFormer's focal and dice terms.

    ``mask_classes`` are the semantic ids of the mask head. ``background_voxels``: which voxels
    are the background's, beside those of the background classes: "unclaimed" also those of
    foreground classes that belong to no object (outside of the view, hidden, too small);
    "background" no others (the paper's partition); "all" every one. ``weights`` by term: the
    paper's four must be given, those beyond the paper (``mask_ce``, ``scene_dice``, ``sem_scal``,
    ``geo_scal``, ``foreground_bce``) are left out at 0. ``unknown_weight``: see ``background_bce``.
    ``objects``: how the truth of an object's cells is made. Raises InputError if a weight is
    missing, unknown or negative, or a class is unknown.

    ``scene_sums``: what ``ClassThresholds.observe`` takes, of the last batch.
    """

    mask_index: Tensor
    scene_sums: tuple[Float[Tensor, "batch class"], Float[Tensor, "batch class"]] | None = None

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
        index = torch.full((256,), EMPTY, dtype=torch.long)
        index[list(mask_classes)] = torch.arange(len(mask_classes))
        index[IGNORE] = UNKNOWN
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
        classes = truth.labels
        if self.background_voxels == "unclaimed":
            classes = classes.masked_fill(truth.owner > 0, 0)
        for class_id in self.emptied_classes:
            classes = classes.masked_fill(truth.labels == class_id, 0)
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
        terms = []
        for frame, (queries, objects) in enumerate(matches):
            pairs = slots.query_indices[frame, :, None] == queries
            slot = matched_first(pairs)
            pairs = pairs[slot]
            boxes = slots.boxes3d[frame, slot]
            found = objects[pairs.to(torch.uint8).argmax(1)] if len(slot) else objects[:0]
            grids = truth.owner[frame], truth.labels[frame]
            side, rule = logits.shape[-1], self.objects.resampling
            occupied, known = resample_objects(*grids, found, boxes, side, rule)
            counts = pairs.any(1)
            if self.objects.missed_boxes == "skip":
                counts = counts & (occupied.sum(1) > 0)
            predicted = logits[frame, slot].float().flatten(1)
            dice = dice_loss(predicted, occupied, known)
            cells = F.binary_cross_entropy_with_logits(predicted, occupied, reduction="none")
            entropy = (cells * known).sum(1) / known.sum(1).clamp(min=1)
            weight = counts.float()
            terms.append(torch.stack([weight @ dice, weight @ entropy, weight.sum()]))
        dice, entropy, number = torch.stack(terms).sum(0)
        count = normalizer(number.detach(), logits.device)
        anchor = 0.0 * logits.sum()
        losses = {"foreground_dice": self.weights["foreground_dice"] * dice / count + anchor}
        if weight := self.weights["foreground_bce"]:
            losses["foreground_bce"] = weight * entropy / count
        return losses

    def mask_losses(
        self, output: OccupancyOutput, classes: UInt8[Tensor, "batch x y z"]
    ) -> dict[str, Tensor]:
        """Focal and dice terms per class over the candidates; unknown voxels do not count.

        Beyond the paper: ``mask_ce``, the cross-entropy over the classes of occupied voxels, since
        fusion compares classes; and ``scene_dice``, the dice loss of occupancy times class, which
        is what fusion writes. Like IoU, it rewards filling a voxel whose probability is above half
        of the class's dice, which may be far below one half. In it, true voxels that are not among
        the candidates count as missed. ``sem_scal`` and ``geo_scal`` are MonoScene's scene-class
        affinity losses of the same product by class, and of the occupancy.
        """
        assert output.voxels is not None
        assert output.mask_logits is not None
        found = gather_cells(classes, output.voxels.coordinates)
        index = self.mask_index[found.long()]
        sums = mask_sums(output.mask_logits, output.voxels.logits, index)
        focal, dice, entropy = mask_means(sums)
        named = {
            "mask_focal": self.weights["mask_focal"] * focal,
            "mask_dice": self.weights["mask_dice"] * dice,
        }
        if weight := self.weights["mask_ce"]:
            named["mask_ce"] = weight * entropy
        counts = class_counts(classes)
        count = counts[:, self.mask_classes]
        self.scene_sums = sums.hits.detach(), sums.written.detach() + count
        if weight := self.weights["scene_dice"]:
            scene = mean_present(class_dice(sums.hits, sums.written, count), count)
            named["scene_dice"] = weight * scene.sum() / normalizer(len(scene), found.device)
        if weight := self.weights["sem_scal"]:
            known = counts[:, :IGNORE].sum(1, keepdim=True)
            scal = mean_present(class_affinity(sums.hits, sums.written, count, known), count)
            named["sem_scal"] = weight * scal.sum() / normalizer(len(scal), found.device)
        if weight := self.weights["geo_scal"]:
            scal = occupancy_affinity(output.voxels.logits, found, counts)
            named["geo_scal"] = weight * scal.sum() / normalizer(len(scal), found.device)
        for layer in output.aux_mask_logits:  # the paper's two terms, summed over the layers
            focal, dice, _ = mask_means(mask_sums(layer, output.voxels.logits, index))
            for name, value in (("mask_focal", focal), ("mask_dice", dice)):
                term = self.weights[name] * value
                named[f"aux_{name}"] = named.get(f"aux_{name}", 0.0) + term
        return named


def matched_first(pairs: Bool[Tensor, "slot pair"]) -> Int[Tensor, " _"]:
    """The slots that take part in a pair, and others, if the pairs do not all have a slot: as many
    as there can be, so that the number does not depend on what was matched."""
    return pairs.any(1).to(torch.uint8).topk(min(pairs.shape)).indices


def class_counts(classes: UInt8[Tensor, "batch x y z"]) -> Float[Tensor, "batch 256"]:
    """How many voxels of each frame have each value.

    ``bincount`` is five times as fast as ``histc``, but on a GPU it waits for the device.
    """
    if classes.device.type == "cpu" and not torch.compiler.is_compiling():
        counts = [frame.flatten().bincount(minlength=256).float() for frame in classes]
    else:
        counts = [torch.histc(frame.float(), 256, 0, 256) for frame in classes]
    return torch.stack(counts)


def mask_means(sums: MaskSums) -> tuple[Tensor, Tensor, Tensor]:
    """Focal, dice and cross-entropy over all frames: the sums divided by the numbers of occupied
    voxels, of classes present in each frame, and of occupied voxels."""
    present = sums.count > 0
    dice = class_dice(sums.overlap, sums.area, sums.count) * present
    number = sums.count.sum()
    losses = torch.stack([sums.focal.sum(), dice.sum(), sums.entropy.sum()])
    numbers = torch.stack([number, present.sum().to(number.dtype), number])
    focal, dice, entropy = losses / normalizer(numbers, losses.device)
    return focal, dice, entropy


def class_dice(
    overlap: Float[Tensor, "batch class"],
    area: Float[Tensor, "batch class"],
    count: Float[Tensor, "batch class"],
) -> Float[Tensor, "batch class"]:
    """1 - dice coefficient of each class: probability in its true voxels, in all voxels, and its
    true number of voxels."""
    return 1 - (2 * overlap + 1) / (area + count + 1)


def class_affinity(
    hits: Float[Tensor, "batch class"],
    written: Float[Tensor, "batch class"],
    count: Float[Tensor, "batch class"],
    known: Float[Tensor, "batch 1"],
) -> Float[Tensor, "batch class"]:
    """-log of precision, recall and specificity of each class: the scene-class affinity loss of
    MonoScene (Cao and de Charette, 2022), from sums of probabilities and numbers of voxels."""
    precision = (hits + 1) / (written + 1)
    recall = (hits + 1) / (count + 1)
    specificity = 1 - (written - hits) / (known - count + 1)
    return -(precision.log() + recall.log() + specificity.clamp(min=1e-6).log())


def occupancy_affinity(
    logits: Float[Tensor, "batch voxel"],
    classes: UInt8[Tensor, "batch voxel"],
    counts: Float[Tensor, "batch 256"],
) -> Float[Tensor, " batch"]:
    """``class_affinity`` of occupied voxels; ``classes`` are those of the candidates, ``counts`` of
    the whole grid."""
    known = counts[:, :IGNORE].sum(1, keepdim=True)
    probability = logits.float().sigmoid() * (classes != IGNORE)
    hits = (probability * (classes != 0)).sum(1, keepdim=True)
    written = probability.sum(1, keepdim=True)
    return class_affinity(hits, written, known - counts[:, :1], known)[:, 0]


def mean_present(
    terms: Float[Tensor, "batch class"], count: Float[Tensor, "batch class"]
) -> Float[Tensor, " batch"]:
    """The mean over the classes with a ``count`` above 0, or 0 if there is none."""
    present = count > 0
    return (terms * present).sum(1) / present.sum(1).clamp(min=1)


def dice_loss(
    logits: Float[Tensor, "*n point"], truth: Float[Tensor, "*n point"], weight: Tensor
) -> Float[Tensor, " *n"]:
    """1 - dice coefficient (Milletari et al., 2016), points weighted by ``weight``."""
    probability = logits.sigmoid()
    overlap = (weight * probability * truth).sum(-1)
    total = (weight * probability).sum(-1) + (weight * truth).sum(-1)
    return 1 - (2 * overlap + 1) / (total + 1)
