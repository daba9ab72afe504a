"""Precision and recall of the detected image boxes by the threshold of their score."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from occdetr.classes import CLASS_NAMES
from occdetr.evaluation.recall import FrameBoxes, match_objects
from occdetr.geometry.boxes import box_iou, xyxy_to_cxcywh

#: Scores from which on detections count: those at which TensorBoard draws a curve of 101 points.
THRESHOLDS = np.linspace(0, 1, 101)
OVERALL = "all"  # the curve of the detections of all classes together
MIN_IOU = 0.5


@dataclass(frozen=True)
class PrecisionRecall:
    """Numbers of detections with at least each of ``THRESHOLDS``: right ones and wrong ones.

    ``objects``: the number of objects. A precision without detections is 1.
    """

    true_positives: Int[np.ndarray, " threshold"]
    false_positives: Int[np.ndarray, " threshold"]
    objects: int

    @property
    def false_negatives(self) -> Int[np.ndarray, " threshold"]:
        return self.objects - self.true_positives

    @property
    def precision(self) -> Float[np.ndarray, " threshold"]:
        found = self.true_positives + self.false_positives
        return np.where(found, self.true_positives / np.maximum(found, 1), 1.0)

    @property
    def recall(self) -> Float[np.ndarray, " threshold"]:
        return self.true_positives / max(self.objects, 1)


def precision_recall_curves(frames: Iterable[FrameBoxes]) -> dict[str, PrecisionRecall]:
    """The curve of every class with objects, by its name, and that of all, ``OVERALL``.

    A detection is right if ``match_objects`` gives it an object by the IoU of the image boxes, at
    least 0.5, as COCO counts AP50. There are no curves without objects.
    """
    columns: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    object_classes = [np.zeros(0)]
    for detections, objects in frames:
        columns.append((detections[:, 0], detections[:, 1], _right_ones(detections, objects)))
        object_classes.append(objects[:, 0])
    truth = np.concatenate(object_classes)
    if not len(truth):
        return {}
    scores, classes, right = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    curves = {OVERALL: _curve(scores, right, len(truth))}
    for class_id in np.unique(truth):
        own = classes == class_id
        number = int((truth == class_id).sum())
        curves[CLASS_NAMES[int(class_id)]] = _curve(scores[own], right[own], number)
    return curves


def _right_ones(
    detections: Float[np.ndarray, "detection 12"], objects: Float[np.ndarray, "object 11"]
) -> Bool[np.ndarray, " detection"]:
    boxes = xyxy_to_cxcywh(torch.from_numpy(detections[:, 2:6]))
    truth = xyxy_to_cxcywh(torch.from_numpy(objects[:, 1:5]))
    iou = box_iou(boxes[:, None], truth[None]).numpy()
    columns = detections[:, 0], detections[:, 1], objects[:, 0], iou
    return match_objects(*columns, min_score=0.0, min_iou=MIN_IOU) >= 0


def _curve(
    scores: Float[np.ndarray, " detection"], right: Bool[np.ndarray, " detection"], objects: int
) -> PrecisionRecall:
    true, false = (_at_least(scores[chosen]) for chosen in (right, ~right))
    return PrecisionRecall(true, false, objects)


def _at_least(scores: Float[np.ndarray, " detection"]) -> Int[np.ndarray, " threshold"]:
    """How many scores are not below each of ``THRESHOLDS``."""
    return len(scores) - np.searchsorted(np.sort(scores), THRESHOLDS)
