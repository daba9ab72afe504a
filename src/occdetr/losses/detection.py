"""The detection terms of the paper's loss (III-D): class, 2D box and 3D box."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
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
        self, layers: Sequence[LayerDetections | Proposals], targets: list[SceneTarget]
    ) -> list[list[Match]]:
        """Hungarian assignment of the predictions of each layer."""
        return self.matcher(
            [layer.pred_logits for layer in layers],
            [layer.pred_boxes for layer in layers],
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
        layers = self.layer_losses(output.layers, targets, layer_matches, count)
        losses = {name: values[-1] for name, values in layers.items()}
        if len(output.layers) > 1:
            losses |= {f"aux_{name}": values[:-1].sum() for name, values in layers.items()}
        proposals = self.layer_losses(output.supervised[-1:], targets, [proposal_matches], count)
        return losses | {f"proposal_{name}": values[0] for name, values in proposals.items()}

    def layer_losses(
        self,
        layers: Sequence[LayerDetections | Proposals],
        targets: list[SceneTarget],
        matches: list[list[Match]],
        count: int | Tensor,
    ) -> dict[str, Float[Tensor, " layer"]]:
        """The terms of each of several layers of one kind, with as many matches, divided by
        ``count``, the number of objects (``normalizer``)."""
        place, own = _places_of(matches, targets)
        classes = self.class_index[torch.cat([t.classes for t in targets])[own]]
        logits = torch.stack([layer.pred_logits for layer in layers]).float()
        truth = torch.zeros_like(logits).index_put_((*place, classes), logits.new_ones(()))
        losses = {"cls": focal_loss(logits, truth)}

        first = layers[0]
        if isinstance(first, LayerDetections) or first.refined:  # preset boxes learn nothing
            predicted = torch.stack([layer.pred_boxes for layer in layers])[place].float()
            boxes = torch.cat([t.boxes_cxcywh for t in targets])[own]
            losses["box2d"] = (predicted - boxes).abs().sum(-1)
            losses["giou2d"] = 1 - generalized_box_iou(predicted, boxes)
        decoded = [layer.pred_boxes3d for layer in layers if isinstance(layer, LayerDetections)]
        if decoded:
            predicted = torch.stack(decoded)[place].float()
            boxes = torch.cat([t.boxes3d_camera for t in targets])[own]
            losses["box3d"] = box3d_l1(predicted, boxes)
            losses["giou3d"] = 1 - generalized_box_iou(predicted, boxes)
        sums = {
            name: terms.reshape(len(layers), terms.numel() // len(layers)).sum(1)
            for name, terms in losses.items()
        }
        return {name: self.weights[name] * value / count for name, value in sums.items()}


def _places_of(
    matches: list[list[Match]], targets: list[SceneTarget]
) -> tuple[tuple[Tensor, Tensor, Tensor], Int[Tensor, " pair"]]:
    """Layer, frame and query of every pair, and its object among those of all frames."""
    pairs = [
        (torch.full_like(queries, layer), torch.full_like(queries, frame), queries, objects + start)
        for layer, frames in enumerate(matches)
        for frame, ((queries, objects), start) in enumerate(
            zip(frames, itertools.accumulate(map(len, targets), initial=0), strict=False)
        )
    ]
    layer, frame, query, own = map(torch.cat, zip(*pairs, strict=True))
    return (layer, frame, query), own


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
