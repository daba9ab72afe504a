"""Terms for the first surface on each token's ray: its depth and its class (beyond the paper)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from occdetr.classes import IGNORE
from occdetr.geometry.depths import depth_position, depth_unit
from occdetr.structures import SceneBatch, SurfaceOutput


class SurfaceCriterion(nn.Module):
    """Cross-entropy over the intervals of depth and over the classes; unknown rays do not count."""

    def __init__(self, weight_depth: float, weight_class: float) -> None:
        super().__init__()
        self.weight_depth = weight_depth
        self.weight_class = weight_class

    def forward(self, output: SurfaceOutput, batch: SceneBatch) -> dict[str, Tensor]:
        """The weighted terms, by name."""
        assert batch.surface_depth is not None
        assert batch.surface_class is not None
        image_size = (batch.images.shape[-2], batch.images.shape[-1])
        last = output.depth_logits.shape[1] - 1  # nowhere
        unit = depth_unit(batch.projection, image_size)
        depth = batch.surface_depth.nan_to_num(posinf=1e6)
        interval = depth_position(depth, unit, last).floor().clamp(0, last).long()
        classes = batch.surface_class.long()
        interval = torch.where(classes == IGNORE, -1, interval)
        seen = torch.where((classes == IGNORE) | (classes == 0), -1, classes - 1)
        return {
            "surface_depth": self.weight_depth * _entropy(output.depth_logits, interval),
            "surface_class": self.weight_class * _entropy(output.class_logits, seen),
        }


def _entropy(logits: Tensor, index: Tensor) -> Tensor:
    """Mean cross-entropy where ``index`` is not -1; 0 if it is -1 everywhere."""
    total = F.cross_entropy(logits.float(), index, ignore_index=-1, reduction="sum")
    return total / (index >= 0).sum().clamp(min=1)
