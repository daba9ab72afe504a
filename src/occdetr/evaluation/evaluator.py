"""What both stages and ``evaluate`` measure, in one place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.detection import DetectionMetric
from occdetr.evaluation.finite import FiniteOutputs
from occdetr.evaluation.recall import DetectionRecall
from occdetr.geometry.boxes import cxcywh_to_xyxy
from occdetr.models.layers import take
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import DetectorOutput, SceneBatch, SceneOutput

MAX_DETECTIONS = 100  # a frame, COCO's limit


def update_detection(
    metric: DetectionMetric | DetectionRecall,
    detections: DetectorOutput,
    foreground_classes: Tensor,
    batch: SceneBatch,
) -> None:
    """Count the last layer's detections: the best ``MAX_DETECTIONS`` pairs of query and class.

    As Deformable DETR reports them: a query may stand for its second-best class too.
    """
    assert batch.targets is not None
    final = detections.final
    scores = final.pred_logits.float().sigmoid()
    best = scores.flatten(1).topk(min(MAX_DETECTIONS, scores[0].numel()), dim=1)
    queries, classes = best.indices // scores.shape[-1], best.indices % scores.shape[-1]
    metric.update(
        batch.frame_indices,
        best.values,
        foreground_classes[classes],
        cxcywh_to_xyxy(take(final.pred_boxes.float(), queries)),
        take(final.pred_boxes3d.float(), queries),
        batch.targets,
    )


class SceneEvaluator(nn.Module):
    """SSC and detection metrics of fused predictions; ``detects``: whether there is a detector."""

    def __init__(self, image_size: Sequence[int], *, detects: bool) -> None:
        super().__init__()
        self.detects = detects
        self.completion = SemanticSceneCompletion()
        size = (int(image_size[0]), int(image_size[1]))
        self.detection = DetectionMetric(size)
        self.recall = DetectionRecall()
        self.finite = FiniteOutputs()

    def update(self, model: OccupancyDETR, batch: SceneBatch) -> tuple[SceneOutput, Tensor]:
        """Predict a batch and count it; returns what ``predict`` does. Raises as ``compute``."""
        output, grid = model.predict(batch)
        self.finite.update(batch.frame_ids, output.detections, output.occupancy)
        assert batch.labels is not None
        self.completion.update(grid, batch.labels)
        if output.detections is not None:
            for metric in (self.detection, self.recall):
                update_detection(metric, output.detections, model.foreground_classes, batch)
        return output, grid

    def compute(self) -> dict[str, Any]:
        """All figures, over all ranks, so that every rank must call it, one without frames too.

        Detection figures are 0 without a detector. Raises ``NonFiniteError`` if an output was not
        finite.
        """
        self.finite.compute()
        figures = self.completion.compute()
        detection, found = {"mAP": 0.0, "AP50": 0.0, "recall3d_25": 0.0}, {}
        if self.detects:
            detection, found = self.detection.compute(), self.recall.compute()
        return {**figures, **detection, "objects_found": found}

    def reset(self) -> None:
        for metric in (self.completion, self.detection, self.recall, self.finite):
            metric.reset()


def numbers(results: dict[str, Any]) -> dict[str, float]:
    """The single figures among ``results``, without tables and counts by class or distance."""
    return {k: float(v) for k, v in results.items() if isinstance(v, (int, float))}


def scalar_figures(results: dict[str, Any], prefix: str) -> dict[str, Tensor]:
    """Figures of ``SceneEvaluator`` as tensors to log, per-class IoU included."""
    flat = {f"{prefix}/{k}": v for k, v in numbers(results).items()}
    for name, value in results.get("per_class", {}).items():
        flat[f"{prefix}_iou/{name}"] = value
    return {k: torch.tensor(v, dtype=torch.float32) for k, v in flat.items()}
