"""COCO mAP of the image boxes, and recall of the 3D boxes.

faster-coco-eval is used directly, because
``torchmetrics.detection.MeanAveragePrecision(backend="faster_coco_eval")`` does not import without
torchvision.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from faster_coco_eval import COCO, COCOeval_faster
from jaxtyping import Float, Int
from torch import Tensor
from torchmetrics import Metric

from occdetr.classes import CLASS_NAMES
from occdetr.evaluation.recall import FOUND_SCORE, FrameBoxes, recall_3d
from occdetr.geometry.boxes import cxcywh_to_xyxy
from occdetr.structures import SceneTarget


class DetectionMetric(Metric):
    """COCO mAP (.50:.95) and AP50 of the image boxes, and recall of the 3D boxes at IoU 0.25.

    Args:
        image_size: (height, width) in pixels, to which normalised boxes are scaled.
        score_threshold: lowest score of a detection that counts for the 3D recall.

    A frame that is passed twice, as by a sampler that pads, counts once. ``boxes`` are those of
    every frame of all ranks, by its index, which the last ``compute`` has counted.

    Examples:
        >>> import torch
        >>> from occdetr.evaluation.detection import DetectionMetric
        >>> from occdetr.structures import empty_target
        >>> target = empty_target()
        >>> target.classes = torch.tensor([1])  # a car
        >>> target.boxes_cxcywh = torch.tensor([[0.5, 0.5, 0.2, 0.2]])
        >>> target.boxes3d_camera = torch.tensor([[0.0, 0.0, 10.0, 2.0, 1.5, 4.0]])
        >>> metric = DetectionMetric()
        >>> metric.update(
        ...     frame_indices=torch.tensor([0]),
        ...     scores=torch.tensor([[0.9]]),
        ...     classes=torch.tensor([[1]]),
        ...     boxes_xyxy=torch.tensor([[[0.4, 0.4, 0.6, 0.6]]]),
        ...     boxes3d=torch.tensor([[[0.0, 0.0, 10.5, 2.0, 1.5, 4.0]]]),
        ...     targets=[target],
        ... )
        >>> metric.compute()
        {'mAP': 1.0, 'AP50': 1.0, 'recall3d_25': 1.0}
    """

    full_state_update = False
    frames: list[Tensor]
    detections: list[Tensor]
    objects: list[Tensor]

    def __init__(
        self, image_size: tuple[int, int] = (370, 1220), score_threshold: float = FOUND_SCORE
    ) -> None:
        super().__init__()
        self.image_size = (int(image_size[0]), int(image_size[1]))
        self.score_threshold = score_threshold
        self.boxes: dict[int, FrameBoxes] = {}
        # Flat vectors: a rank without frames sends an empty one, which must have as many axes.
        self.add_state("frames", default=[], dist_reduce_fx="cat")  # index, detections, objects
        self.add_state("detections", default=[], dist_reduce_fx="cat")  # score, class, xyxy, 3D
        self.add_state("objects", default=[], dist_reduce_fx="cat")  # class, xyxy, 3D

    def update(
        self,
        frame_indices: Int[Tensor, " batch"],
        scores: Float[Tensor, "batch detection"],
        classes: Int[Tensor, "batch detection"],
        boxes_xyxy: Float[Tensor, "batch detection 4"],
        boxes3d: Float[Tensor, "batch detection 6"],
        targets: Sequence[SceneTarget],
    ) -> None:
        """Add a batch.

        Args:
            frame_indices: positions of the frames in the split.
            scores: confidences in [0, 1].
            classes: semantic ids 1-19.
            boxes_xyxy: image boxes, normalised.
            boxes3d: (centre, size) in metres, camera frame.
            targets: the true objects of each frame.
        """
        for b, target in enumerate(targets):
            found = [scores[b, :, None], classes[b, :, None], boxes_xyxy[b], boxes3d[b]]
            true_xyxy = cxcywh_to_xyxy(target.boxes_cxcywh)
            truth = [target.classes[:, None], true_xyxy, target.boxes3d_camera]
            counts = torch.tensor([float(frame_indices[b]), scores.shape[1], len(target)])
            for state, rows in (
                (self.frames, counts),
                (self.detections, torch.cat([column.float() for column in found], dim=1)),
                (self.objects, torch.cat([column.float() for column in truth], dim=1)),
            ):
                state.append(rows.detach().flatten().to(self.device))

    def compute(self) -> dict[str, float]:
        """``mAP``, ``AP50`` and ``recall3d_25`` in [0, 1]; 0 if there are no objects at all."""
        self.boxes = _split_frames(
            _rows(self.frames, 3), _rows(self.detections, 12), _rows(self.objects, 11)
        )
        mean_precision, precision_50 = average_precision(self.boxes, self.image_size)
        recall = recall_3d(self.boxes.values(), min_iou=0.25, min_score=self.score_threshold)
        return {"mAP": mean_precision, "AP50": precision_50, "recall3d_25": recall}

    def reset(self) -> None:
        super().reset()
        self.boxes = {}


def _rows(state: list[Tensor] | Tensor, width: int) -> np.ndarray:
    """A state, which is a list before synchronisation and a tensor after it, as a table."""
    if not len(state):
        return np.zeros((0, width), dtype=np.float32)
    flat = state if isinstance(state, Tensor) else torch.cat(state)
    return flat.cpu().numpy().reshape(-1, width)


def _split_frames(
    frames: np.ndarray, detections: np.ndarray, objects: np.ndarray
) -> dict[int, FrameBoxes]:
    """The rows of each frame, by frame index; of a frame that occurs twice the first is kept."""
    index, num_detections, num_objects = frames.astype(np.int64).T
    parts = (
        zip(
            index.tolist(),
            np.split(detections, np.cumsum(num_detections)[:-1]),
            np.split(objects, np.cumsum(num_objects)[:-1]),
            strict=True,
        )
        if len(index)
        else ()
    )
    boxes: dict[int, FrameBoxes] = {}
    for frame, frame_detections, frame_objects in parts:
        boxes.setdefault(frame, (frame_detections, frame_objects))
    return boxes


def average_precision(
    frames: Mapping[int, FrameBoxes], image_size: tuple[int, int]
) -> tuple[float, float]:
    """COCO's mAP (.50:.95) and AP50: all areas, 100 detections per image.

    The mean is over the classes that occur in the truth. ``frames``: boxes by frame index,
    normalised; ``image_size``: (height, width) in pixels. (0, 0) without objects or detections.
    """
    height, width = image_size
    scale = np.array([width, height, width, height], dtype=np.float64)
    truth, found = [], []
    for frame, (detections, objects) in frames.items():
        truth += _annotations(frame, objects[:, 0], objects[:, 1:5] * scale)
        found += _annotations(frame, detections[:, 1], detections[:, 2:6] * scale, detections[:, 0])
    for number, annotation in enumerate(truth):
        annotation["id"] = number + 1  # COCO's matching uses 0 for "no match"
    categories = sorted({annotation["category_id"] for annotation in truth})
    found = [annotation for annotation in found if annotation["category_id"] in categories]
    if not truth or not found:
        return 0.0, 0.0
    images = [{"id": frame, "height": height, "width": width} for frame in frames]
    named = [{"id": category, "name": CLASS_NAMES[category]} for category in categories]
    ground_truth = COCO({"images": images, "annotations": truth, "categories": named})
    evaluation = COCOeval_faster(ground_truth, ground_truth.loadRes(found), iouType="bbox")
    evaluation.params.areaRng = evaluation.params.areaRng[:1]
    evaluation.params.areaRngLbl = ["all"]
    evaluation.params.maxDets = [100]
    evaluation.evaluate()
    evaluation.accumulate()
    precision = evaluation.eval["precision"]  # threshold, recall, class, area, detections
    return float(precision.mean()), float(precision[0].mean())


def _annotations(
    frame: int, classes: np.ndarray, boxes_xyxy: np.ndarray, scores: np.ndarray | None = None
) -> list[dict[str, Any]]:
    """The boxes of one frame, in pixels, as COCO annotations."""
    corners, sizes = boxes_xyxy[:, :2], boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]
    columns = (
        classes.astype(np.int64).tolist(),
        np.concatenate([corners, sizes], axis=1).tolist(),
        sizes.prod(axis=1).tolist(),
        (np.ones(len(classes)) if scores is None else scores).tolist(),
    )
    shared = {"image_id": frame, "iscrowd": 0}
    return [
        {"category_id": category, "bbox": box, "area": area, "score": score, **shared}
        for category, box, area, score in zip(*columns, strict=True)
    ]
