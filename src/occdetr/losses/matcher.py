"""Hungarian matching of predictions and objects (DETR; costs of Deformable DETR)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from occdetr.errors import NOT_NEGATIVE, InputError, check_ranges
from occdetr.geometry.boxes import generalized_box_iou

NO_MATCH = 1e9  # the cost of a match that is not finite

Match = tuple[Int[Tensor, " _"], Int[Tensor, " _"]]
"""Matched rows of one frame: (index of the prediction, index of the object)."""


def to_host(values: Tensor) -> Tensor:
    """On the CPU. It waits for the device, so it is called once in a step."""
    return values.cpu()


def to_device(pairs: Sequence[Int[Tensor, "2 _"]], device: torch.device) -> list[Match]:
    """Matches that were found on the CPU, in one copy that does not wait for the device."""
    moved = torch.cat(list(pairs), dim=1).to(device, non_blocking=True)
    split = moved.split([part.shape[1] for part in pairs], dim=1)
    return [(part[0], part[1]) for part in split]


class HungarianMatcher(nn.Module):
    """One-to-one assignment that minimises class, L1 and GIoU costs.

    Raises InputError on weights of the costs below 0, and if all are 0.
    """

    def __init__(self, cost_class: float, cost_box: float, cost_giou: float) -> None:
        super().__init__()
        self.cost_class, self.cost_box, self.cost_giou = cost_class, cost_box, cost_giou
        costs = ("cost_class", "cost_box", "cost_giou")
        check_ranges("loss.detection.matcher", self, **dict.fromkeys(costs, NOT_NEGATIVE))
        if not any(getattr(self, name) for name in costs):
            raise InputError(
                f"loss.detection.matcher: {', '.join(costs)} are all 0: give one of them more"
            )

    @torch.no_grad()
    def forward(
        self,
        pred_logits: Sequence[Float[Tensor, "batch _ class"]],
        pred_boxes: Sequence[Float[Tensor, "batch _ 4"]],
        classes: list[Int[Tensor, " _"]],
        boxes: list[Float[Tensor, "_ 4"]],
    ) -> list[list[Match]]:
        """The matches of each layer and frame; ``classes`` index the logits. The layers may have
        different numbers of queries. A frame may have no objects.

        Predictions that are not finite are matched last, so that their losses say what is wrong.
        The costs of all layers go to the host at once, and so do the matches come back.
        """
        sizes = [logits.shape[1] for logits in pred_logits]
        cost = self.cost(
            torch.cat(list(pred_logits), dim=1),
            torch.cat(list(pred_boxes), dim=1),
            pad_sequence(classes, batch_first=True),
            pad_sequence(boxes, batch_first=True),
        )
        cost = cost.float().nan_to_num(NO_MATCH, NO_MATCH, -NO_MATCH)
        pairs = [
            torch.from_numpy(np.stack(linear_sum_assignment(part[:, : len(own)])))
            for layer in np.split(to_host(cost).numpy(), np.cumsum(sizes)[:-1], axis=1)
            for part, own in zip(layer, classes, strict=True)
        ]
        found = to_device(pairs, cost.device)
        return [found[at : at + len(classes)] for at in range(0, len(found), len(classes))]

    def cost(
        self,
        logits: Float[Tensor, "batch query class"],
        predicted: Float[Tensor, "batch query 4"],
        classes: Int[Tensor, "batch object"],
        boxes: Float[Tensor, "batch object 4"],
    ) -> Float[Tensor, "batch query object"]:
        """The focal class cost, L1 and negative GIoU, summed with their weights."""
        probability, predicted = logits.float().sigmoid(), predicted.float()
        positive = 0.25 * (1 - probability) ** 2 * -(probability + 1e-8).log()
        negative = 0.75 * probability**2 * -(1 - probability + 1e-8).log()
        own = classes[:, None].expand(-1, logits.shape[1], -1)
        focal = (positive - negative).gather(2, own)
        l1 = torch.cdist(predicted, boxes, p=1)
        giou = generalized_box_iou(predicted[:, :, None], boxes[:, None])
        return self.cost_class * focal + self.cost_box * l1 - self.cost_giou * giou
