"""The losses written out frame by frame and object by object, over selected rows."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from occdetr.classes import IGNORE
from occdetr.geometry.boxes import generalized_box_iou
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.losses.matcher import Match
from occdetr.losses.targets import SUPERSAMPLE, SceneTruth
from occdetr.structures import OccupancyOutput, SceneTarget


def focal(logits: Tensor, truth: Tensor) -> Tensor:
    right = torch.where(truth > 0, logits.sigmoid(), (-logits).sigmoid())
    alpha = torch.where(truth > 0, 0.25, 0.75)
    return -alpha * (1 - right) ** 2 * F.logsigmoid(torch.where(truth > 0, logits, -logits))


def dice(probability: Tensor, truth: Tensor, total: Tensor) -> Tensor:
    return 1 - (2 * (probability * truth).sum(-1) + 1) / (probability.sum(-1) + total + 1)


def mask_terms(criterion: Any, output: OccupancyOutput, classes: Tensor) -> dict[str, Tensor]:
    """The weighted terms of the mask head, from one-hot truths."""
    ids = torch.tensor(criterion.mask_classes)
    sums = dict.fromkeys(("focal", "dice", "ce", "scene"), torch.zeros(()))
    voxels = present = 0
    for frame, own_classes in enumerate(classes):
        x, y, z = output.voxels.coordinates[frame].unbind(1)
        labels = own_classes[x, y, z]
        known = labels != IGNORE
        logits, labels = output.mask_logits[frame][:, known], labels[known]
        truth = (labels[None] == ids[:, None]).to(logits.dtype)
        occupied, there = truth.sum(0) > 0, truth.sum(1) > 0
        voxels, present = voxels + occupied.sum(), present + there.sum()
        sums["focal"] = sums["focal"] + focal(logits, truth).sum()
        sums["dice"] = sums["dice"] + dice(logits.sigmoid(), truth, truth.sum(1))[there].sum()
        sums["ce"] = sums["ce"] - (logits.log_softmax(0) * truth).sum()
        total = (own_classes[None] == ids[:, None, None, None]).sum((1, 2, 3))
        written = output.voxels.logits[frame][known].sigmoid() * logits.softmax(0)
        scene = dice(written, truth, total)[total > 0]
        sums["scene"] = sums["scene"] + (scene.mean() if len(scene) else 0)
    voxels, present = max(voxels, 1), max(present, 1)
    numbers = {"focal": voxels, "dice": present, "ce": voxels, "scene": len(classes)}
    names = {"focal": "mask_focal", "dice": "mask_dice", "ce": "mask_ce", "scene": "scene_dice"}
    return {n: criterion.weights[n] * sums[k] / numbers[k] for k, n in names.items()}


def foreground_terms(
    criterion: Any, output: OccupancyOutput, truth: SceneTruth, matches: list[Match]
) -> dict[str, Tensor]:
    """Dice and BCE of every matched query that has a slot, slot by slot."""
    slots, side = output.slots, output.foreground_logits.shape[-1]
    dices, entropies = [], []
    for frame, (queries, objects) in enumerate(matches):
        for query, number in zip(queries.tolist(), objects.tolist(), strict=True):
            for slot in (slots.query_indices[frame] == query).nonzero()[:, 0].tolist():
                box = slots.boxes3d[frame, slot]
                mine, known = (
                    points_in_cells(grid, box, side)
                    for grid in (truth.owner[frame] == number + 1, truth.labels[frame] != IGNORE)
                )
                if criterion.objects.missed_boxes == "skip" and mine.sum() == 0:
                    continue
                logits = output.foreground_logits[frame, slot].flatten()
                probability = known * logits.sigmoid()
                dices.append(dice(probability, mine, (known * mine).sum()))
                cells = F.binary_cross_entropy_with_logits(logits, mine, reduction="none")
                entropies.append((cells * known).sum() / known.sum().clamp(min=1))
    anchor, count = 0 * output.foreground_logits.sum(), max(len(dices), 1)
    sums = {"foreground_dice": dices, "foreground_bce": entropies}
    return {n: anchor + criterion.weights[n] * sum(v, anchor) / count for n, v in sums.items()}


def points_in_cells(grid: Tensor, box: Tensor, side: int) -> Tensor:
    """The share of the points of each cell of a box that are in marked voxels."""
    steps = (torch.arange(side * SUPERSAMPLE) + 0.5) / (side * SUPERSAMPLE) - 0.5
    origin = torch.tensor(GRID_ORIGIN)[:, None]
    places = (box[:3, None] + box[3:, None] * steps - origin) / VOXEL_SIZE
    index = torch.stack(torch.meshgrid(*places.floor().long(), indexing="ij"), -1)
    inside = ((index >= 0) & (index < torch.tensor(GRID_SHAPE))).all(-1)
    x, y, z = (index * inside[..., None]).unbind(-1)
    found = (grid[x, y, z] & inside).float()
    return F.avg_pool3d(found[None], SUPERSAMPLE)[0].flatten()


def detection_terms(
    weights: dict[str, float],
    layer: Any,
    classes: list[int],
    targets: list[SceneTarget],
    matches: list[Match],
) -> dict[str, Tensor]:
    """The terms of one decoder layer, pair by pair."""
    terms: dict[str, Tensor] = {name: 0 * layer.pred_boxes3d.sum() for name in weights}
    count = max(sum(map(len, targets)), 1)
    for frame, (target, (queries, objects)) in enumerate(zip(targets, matches, strict=True)):
        truth = torch.zeros_like(layer.pred_logits[frame])
        for q, o in zip(queries.tolist(), objects.tolist(), strict=True):
            truth[q, classes.index(int(target.classes[o]))] = 1
            found, true = layer.pred_boxes[frame, q], target.boxes_cxcywh[o]
            terms["box2d"] = terms["box2d"] + (found - true).abs().sum()
            terms["giou2d"] = terms["giou2d"] + 1 - generalized_box_iou(found, true)
            found, true = layer.pred_boxes3d[frame, q], target.boxes3d_camera[o]
            center = (found[:3] - true[:3]).abs().sum() / 5
            size = (found[3:].log() - true[3:].clamp(min=0.05).log()).abs().sum()
            terms["box3d"] = terms["box3d"] + center + size
            terms["giou3d"] = terms["giou3d"] + 1 - generalized_box_iou(found, true)
        terms["cls"] = terms["cls"] + focal(layer.pred_logits[frame], truth).sum()
    return {name: weights[name] * value / count for name, value in terms.items()}
