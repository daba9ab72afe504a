"""Recall of objects: which objects a detection finds, overall, by class and by distance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torchmetrics import Metric

from occdetr.classes import CLASS_NAMES, NUM_CLASSES
from occdetr.evaluation.distance import BANDS, band_of
from occdetr.geometry.boxes import box_iou, xyxy_to_cxcywh
from occdetr.structures import SceneTarget

#: Lowest score of a detection that can find an object, independent of fusion's threshold.
FOUND_SCORE = 0.3

#: Detections (score, class, xyxy, 3D box) and objects (class, xyxy, 3D box) of one frame.
FrameBoxes = tuple[Float[np.ndarray, "detection 12"], Float[np.ndarray, "object 11"]]


def match_objects(
    scores: Float[np.ndarray, " detection"],
    classes: Shaped[np.ndarray, " detection"],
    object_classes: Shaped[np.ndarray, " object"],
    iou: Float[np.ndarray, "detection object"],
    min_score: float,
    min_iou: float,
) -> Int[np.ndarray, " detection"]:
    """The object of its class that each detection of a frame finds, or -1.

    Detections and objects are matched one to one, greedily: each detection with a score of at
    least ``min_score``, in descending order of score, takes the object that it overlaps most among
    those not taken yet, if their IoU is at least ``min_iou``.
    """
    matched, taken = np.full(len(scores), -1), np.zeros(len(object_classes), dtype=bool)
    iou = np.where(classes[:, None] == object_classes[None], iou, -1.0)
    candidates = np.flatnonzero((scores >= min_score) & (iou >= min_iou).any(axis=1))
    for detection in candidates[np.argsort(-scores[candidates], kind="stable")]:
        free = np.where(taken, -1.0, iou[detection])
        best = free.argmax()
        if free[best] >= min_iou:
            matched[detection], taken[best] = best, True
    return matched


def found_objects(
    scores: Float[np.ndarray, " detection"],
    classes: Shaped[np.ndarray, " detection"],
    object_classes: Shaped[np.ndarray, " object"],
    iou: Float[np.ndarray, "detection object"],
    min_score: float,
    min_iou: float,
) -> Bool[np.ndarray, " object"]:
    """Which objects of a frame ``match_objects`` gives to a detection."""
    matched = match_objects(scores, classes, object_classes, iou, min_score, min_iou)
    return np.isin(np.arange(len(object_classes)), matched)


def recall_3d(frames: Iterable[FrameBoxes], min_iou: float, min_score: float) -> float:
    """Share of all objects that ``found_objects`` finds by the IoU of the 3D boxes.

    0 if there are no objects.
    """
    num_found = num_objects = 0
    for detections, objects in frames:
        boxes3d, true_boxes3d = (torch.from_numpy(rows[:, -6:]) for rows in (detections, objects))
        iou = box_iou(boxes3d[:, None], true_boxes3d[None]).numpy()
        found = found_objects(
            *(detections[:, 0], detections[:, 1], objects[:, 0], iou),
            min_score=min_score,
            min_iou=min_iou,
        )
        num_objects += len(found)
        num_found += int(found.sum())
    return num_found / num_objects if num_objects else 0.0


class DetectionRecall(Metric):
    """Number of objects, and of objects found, by class and band of distance.

    Found means by ``found_objects`` with detections of at least ``score_threshold``: once by the
    image boxes at an IoU of 0.5, once by the 3D boxes at 0.25. Every frame must be passed once.
    The state ``counts`` (int64 [objects | found in 2D | found in 3D, class, band]) is summed over
    ranks.
    """

    full_state_update = False
    counts: Tensor

    def __init__(self, score_threshold: float = FOUND_SCORE) -> None:
        super().__init__()
        self.score_threshold = score_threshold
        zeros = torch.zeros(3, NUM_CLASSES, len(BANDS), dtype=torch.int64)
        self.add_state("counts", default=zeros, dist_reduce_fx="sum")

    def update(
        self,
        frame_indices: Int[Tensor, " batch"],
        scores: Float[Tensor, "batch detection"],
        classes: Int[Tensor, "batch detection"],
        boxes_xyxy: Float[Tensor, "batch detection 4"],
        boxes3d: Float[Tensor, "batch detection 6"],
        targets: Sequence[SceneTarget],
    ) -> None:
        """Count a batch. The arguments are those of ``DetectionMetric.update``."""
        for b, target in enumerate(targets):
            iou_2d = box_iou(xyxy_to_cxcywh(boxes_xyxy[b])[:, None], target.boxes_cxcywh[None])
            iou_3d = box_iou(boxes3d[b][:, None], target.boxes3d_camera[None])
            true_classes = target.classes.cpu().numpy()
            frame = scores[b].cpu().numpy(), classes[b].cpu().numpy(), true_classes
            found = [
                found_objects(*frame, iou.cpu().numpy(), self.score_threshold, min_iou)
                for iou, min_iou in ((iou_2d, 0.5), (iou_3d, 0.25))
            ]
            bands = band_of(target.boxes3d_grid[:, 0]).cpu().numpy()
            for row, selected in enumerate([np.ones(len(target), dtype=bool), *found]):
                bins = true_classes[selected] * len(BANDS) + bands[selected]
                counts = np.bincount(bins, minlength=NUM_CLASSES * len(BANDS))
                counts = torch.from_numpy(counts).view(NUM_CLASSES, len(BANDS))
                self.counts[row] += counts.to(self.counts.device)

    def compute(self) -> dict[str, Any]:
        """``{class: {band: {"objects", "found2d_50", "found3d_25"}}}`` of classes with objects."""
        counts = self.counts.cpu().numpy()
        keys = ("objects", "found2d_50", "found3d_25")
        return {
            CLASS_NAMES[index]: {
                band: dict(zip(keys, counts[:, index, b].tolist(), strict=True))
                for b, band in enumerate(BANDS)
            }
            for index in np.flatnonzero(counts[0].sum(1)).tolist()
        }
