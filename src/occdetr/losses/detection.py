"""The detection terms of the paper's loss (III-D): class, 2D box and 3D box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.classes import check_classes
from occdetr.errors import NOT_NEGATIVE, InputError, check_each
from occdetr.geometry.boxes import generalized_box_iou
from occdetr.losses.matcher import HungarianMatcher, Match
from occdetr.losses.normalization import normalizer
from occdetr.structures import DetectorOutput, LayerDetections, Proposals, SceneTarget

UNIT = 5.0  # metres of centre error that count as 1 in the 3D L1 term
TERMS = ("cls", "box2d", "giou2d", "box3d", "giou3d")


class DetectionCriterion(nn.Module):
    """Sigmoid focal class loss, L1 + GIoU of 2D boxes, L1 + GIoU of 3D boxes, for every layer.

    ``weights``: one for each of ``TERMS``. Returns the weighted terms by name: those of the last
    decoder layer, with the prefix ``aux_`` the sums over the other layers, and with ``proposal_``
    those of the query selection (no 3D boxes, and no 2D boxes if it predicts none). Raises
    InputError if a weight is missing, unknown or negative, or a class is unknown.
    """

    class_index: Tensor

    def __init__(
        self,
        matcher: HungarianMatcher,
        foreground_classes: Sequence[int],
        weights: Mapping[str, float],
    ) -> None:
        super().__init__()
        self.matcher = matcher
        self.weights = check_weights("loss.detection", weights, TERMS, required=TERMS)
        check_classes("foreground_classes", foreground_classes)
        self.foreground_classes = list(foreground_classes)
        index = torch.full((256,), -1, dtype=torch.long)
        index[list(foreground_classes)] = torch.arange(len(foreground_classes))
        self.register_buffer("class_index", index, persistent=False)

    def match(
        self, predictions: LayerDetections | Proposals, targets: list[SceneTarget]
    ) -> list[Match]:
        """Hungarian assignment of one layer's predictions."""
        return self.matcher(
            predictions.pred_logits,
            predictions.pred_boxes,
            [self.class_index[t.classes] for t in targets],
            [t.boxes_cxcywh for t in targets],
        )

    def forward(
        self,
        output: DetectorOutput,
        targets: list[SceneTarget],
        layer_matches: list[list[Match]],
        proposal_matches: list[Match],
    ) -> dict[str, Tensor]:
        """The weighted terms, given the matches of each decoder layer and of the proposals."""
        count = normalizer(sum(map(len, targets)), output.query_feat.device)
        losses = self.layer_losses(output.final, targets, layer_matches[-1], count)
        for layer, matches in zip(output.layers[:-1], layer_matches[:-1], strict=True):
            for name, value in self.layer_losses(layer, targets, matches, count).items():
                losses[f"aux_{name}"] = losses.get(f"aux_{name}", 0.0) + value
        proposals = self.layer_losses(output.proposals, targets, proposal_matches, count)
        return losses | {f"proposal_{name}": value for name, value in proposals.items()}

    def layer_losses(
        self,
        layer: LayerDetections | Proposals,
        targets: list[SceneTarget],
        matches: list[Match],
        count: int | Tensor,
    ) -> dict[str, Tensor]:
        """The terms of one layer, divided by ``count``, the number of objects (``normalizer``)."""
        frames = torch.cat([torch.full_like(q, i) for i, (q, _) in enumerate(matches)])
        queries = torch.cat([q for q, _ in matches])
        logits = layer.pred_logits.float()
        truth = torch.zeros_like(logits)
        classes = torch.cat([t.classes[o] for t, (_, o) in zip(targets, matches, strict=True)])
        truth[frames, queries, self.class_index[classes]] = 1.0
        boxes = torch.cat([t.boxes_cxcywh[o] for t, (_, o) in zip(targets, matches, strict=True)])
        predicted = layer.pred_boxes[frames, queries].float()
        losses = {"cls": focal_loss(logits, truth).sum() / count}
        if isinstance(layer, LayerDetections) or layer.refined:  # preset boxes learn nothing
            losses["box2d"] = (predicted - boxes).abs().sum() / count
            losses["giou2d"] = (1 - generalized_box_iou(predicted, boxes)).sum() / count
        if isinstance(layer, LayerDetections):
            pairs = zip(targets, matches, strict=True)
            boxes3d = torch.cat([t.boxes3d_camera[o] for t, (_, o) in pairs])
            predicted3d = layer.pred_boxes3d[frames, queries].float()
            losses["box3d"] = box3d_l1(predicted3d, boxes3d).sum() / count
            losses["giou3d"] = (1 - generalized_box_iou(predicted3d, boxes3d)).sum() / count
        return {name: self.weights[name] * value for name, value in losses.items()}


def check_weights(
    setting: str, weights: Mapping[str, float], terms: Sequence[str], required: Sequence[str]
) -> dict[str, float]:
    """The weights of all ``terms``, 0 where none is given. Raises InputError, also if all are 0."""
    unknown = [name for name in weights if name not in terms]
    missing = [name for name in required if name not in weights]
    if unknown or missing:
        reason = f"unknown term {unknown[0]!r}" if unknown else f"no weight of {missing[0]!r}"
        raise InputError(f"{setting}.weights: {reason}: the terms are {', '.join(terms)}")
    check_each(f"{setting}.weights", dict(weights), NOT_NEGATIVE)
    if not any(weights.values()):
        raise InputError(f"{setting}.weights: all are 0: nothing would be learned: give some more")
    return {name: float(weights.get(name, 0.0)) for name in terms}


def box3d_l1(
    predicted: Float[Tensor, "object 6"], truth: Float[Tensor, "object 6"]
) -> Float[Tensor, " object"]:
    """L1 of normalised 3D boxes: centres in units of ``UNIT`` metres, sizes by their logarithm."""
    center = (predicted[:, :3] - truth[:, :3]).abs().sum(-1) / UNIT
    size = (predicted[:, 3:].log() - truth[:, 3:].clamp(min=0.05).log()).abs().sum(-1)
    return center + size


def focal_loss(
    logits: Tensor, truth: Tensor | float, alpha: float = 0.25, gamma: float = 2.0
) -> Tensor:
    """Sigmoid focal loss (Lin et al., 2017), elementwise; ``truth`` may be a single value."""
    probability = logits.sigmoid()
    cross_entropy = F.softplus(logits) - truth * logits
    miss = probability + truth - 2 * probability * truth
    weight = alpha * truth + (1 - alpha) * (1 - truth)
    return weight * miss**gamma * cross_entropy
