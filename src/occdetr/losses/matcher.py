"""Hungarian matching of predictions and objects (DETR; costs of Deformable DETR)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from occdetr.errors import NOT_NEGATIVE, InputError, check_ranges
from occdetr.geometry.boxes import generalized_box_iou

NO_MATCH = 1e9  # the cost of a match that is not finite

Match = tuple[Int[Tensor, " _"], Int[Tensor, " _"]]
"""Matched rows of one frame: (index of the prediction, index of the object)."""


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
        pred_logits: Float[Tensor, "batch query class"],
        pred_boxes: Float[Tensor, "batch query 4"],
        classes: list[Int[Tensor, " _"]],
        boxes: list[Float[Tensor, "_ 4"]],
    ) -> list[Match]:
        """The matches of each frame; ``classes`` index the logits. A frame may have no objects.

        Predictions that are not finite are matched last, so that their losses say what is wrong.
        """
        matches = []
        for logits, predicted, frame_classes, frame_boxes in zip(
            pred_logits, pred_boxes, classes, boxes, strict=True
        ):
            cost = self.cost(logits, predicted, frame_classes, frame_boxes)
            cost = cost.float().nan_to_num(NO_MATCH, NO_MATCH, -NO_MATCH)
            rows, columns = linear_sum_assignment(cost.cpu().numpy())
            matches.append(
                (
                    torch.as_tensor(rows, dtype=torch.long, device=logits.device),
                    torch.as_tensor(columns, dtype=torch.long, device=logits.device),
                )
            )
        return matches

    def cost(
        self, logits: Tensor, predicted: Tensor, classes: Tensor, boxes: Tensor
    ) -> Float[Tensor, "query object"]:
        """The focal class cost, L1 and negative GIoU, summed with their weights."""
        probability = logits.float().sigmoid()[:, classes]
        positive = 0.25 * (1 - probability) ** 2 * -(probability + 1e-8).log()
        negative = 0.75 * probability**2 * -(1 - probability + 1e-8).log()
        l1 = torch.cdist(predicted.float(), boxes, p=1)
        giou = generalized_box_iou(predicted.float()[:, None], boxes[None])
        return self.cost_class * (positive - negative) + self.cost_box * l1 - self.cost_giou * giou
