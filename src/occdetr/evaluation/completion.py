"""The figures of merit: semantic scene completion, and detection in 2D and 3D.

Pure functions do the arithmetic; thin torchmetrics classes count over batches and ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from faster_coco_eval import COCO, COCOeval_faster
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torchmetrics import Metric

from occdetr.classes import CLASS_NAMES, IGNORE, NUM_CLASSES
from occdetr.evaluation.recall import BANDS, FOUND_SCORE, band_slices, found_objects
from occdetr.geometry.boxes import box_iou, cxcywh_to_xyxy
from occdetr.structures import SceneTarget

_IOU_EPSILON = 1e-15  # the two constants of the official evaluator, which its last digits need
_COMPLETION_EPSILON = float(np.finfo(np.float32).eps)


def confusion_matrix(
    prediction: UInt8[Tensor, "*grid"], target: UInt8[Tensor, "*grid"]
) -> Int[Tensor, "20 20"]:
    """Voxels counted by predicted class (rows) and true class (columns), int64.

    Voxels whose target is 255 do not count. Raises ``ValueError`` on any other value above 19.
    """
    if prediction.shape != target.shape:
        raise ValueError(f"prediction {prediction.shape} and target {target.shape} differ in shape")
    # one bin per pair of bytes: 255 is then a column to drop, not a mask to apply
    pairs = prediction.flatten().to(torch.int32).mul_(256).add_(target.flatten())
    counts = torch.bincount(pairs, minlength=256 * NUM_CLASSES)
    table = torch.nn.functional.pad(counts, (0, -len(counts) % 256)).view(-1, 256)
    evaluated = table[:, :IGNORE].sum()
    confusion = table[:NUM_CLASSES, :NUM_CLASSES]
    if evaluated != confusion.sum():
        raise ValueError("prediction must hold 0-19, target 0-19 or 255")
    return confusion


def completion_scores(confusion: Int[np.ndarray, "20 20"]) -> dict[str, Any]:
    """SemanticKITTI's scores of a confusion matrix (rows prediction, columns truth).

    ``mIoU``: mean over classes 1-19, an absent class counting 0. ``mIoU_present``: mean over those
    with voxels in the truth. ``IoU``, ``precision``, ``recall``: of "occupied". ``per_class``: IoU
    by name. All in [0, 1], the same floating-point numbers as ``evaluate_completion.py``.
    """
    correct = np.diag(confusion)
    union = confusion.sum(axis=1) + confusion.sum(axis=0) - correct
    iou = correct / (union + _IOU_EPSILON)
    present = iou[1:][confusion.sum(axis=0)[1:] > 0]
    both = confusion[1:, 1:].sum()
    either = confusion.sum() - confusion[0, 0]
    return {
        "mIoU": float(iou[1:].mean()),
        "mIoU_present": float(present.mean()) if present.size else 0.0,
        "IoU": float(both / either) if either else 0.0,
        "precision": float(both / (confusion[1:].sum() + _COMPLETION_EPSILON)),
        "recall": float(both / (confusion[:, 1:].sum() + _COMPLETION_EPSILON)),
        "per_class": {CLASS_NAMES[i]: float(iou[i]) for i in range(1, NUM_CLASSES)},
    }


class SemanticSceneCompletion(Metric):
    """mIoU, and IoU, precision and recall of "occupied", over all frames of all ranks.

    ``bands`` (int64 [3, 20, 20]: band of distance, prediction, truth) is the whole state, beside
    the count of frames. It cannot know a frame it has seen: feed every frame once, so no sampler
    that pads. ``compute`` gives the keys of ``completion_scores``, ``num_frames``, the same scores
    of each of ``BANDS`` in ``by_distance``, and in ``confusion`` the counts as lists.
    """

    full_state_update = False
    bands: Tensor
    num_frames: Tensor

    def __init__(self) -> None:
        super().__init__()
        zeros = torch.zeros(len(BANDS), NUM_CLASSES, NUM_CLASSES, dtype=torch.int64)
        self.add_state("bands", default=zeros, dist_reduce_fx="sum")
        self.add_state(
            "num_frames", default=torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum"
        )

    @property
    def confusion(self) -> Int[Tensor, "20 20"]:
        """The counts of all distances: rows prediction, columns truth."""
        return self.bands.sum(0)

    def update(
        self, prediction: UInt8[Tensor, "batch x y z"], target: UInt8[Tensor, "batch x y z"]
    ) -> None:
        """Count a batch: ``prediction`` 0-19, ``target`` 0-19 or 255 (not evaluated)."""
        parts = [(prediction[:, part], target[:, part]) for part in band_slices()]
        self.bands += torch.stack([confusion_matrix(*part) for part in parts]).to(self.bands.device)
        self.num_frames += len(prediction)

    def compute(self) -> dict[str, Any]:
        bands = self.bands.cpu().numpy()
        by_distance = [completion_scores(confusion) for confusion in bands]
        return {
            **completion_scores(bands.sum(axis=0)),
            "num_frames": int(self.num_frames),
            "by_distance": dict(zip(BANDS, by_distance, strict=True)),
            "confusion": bands.tolist(),
        }


class DetectionMetric(Metric):
    """COCO mAP (.50:.95) and AP50 of the image boxes, and recall of the 3D boxes at IoU 0.25.

    ``image_size`` (height, width) brings normalised boxes to pixels. ``score_threshold``: the least
    score of a detection that counts for the 3D recall. A frame that comes twice, as from a sampler
    that pads, counts once.
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
        # Flat, so that a rank without frames (which sends an empty float32 vector) agrees in rank.
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
        """Take a batch: 2D boxes normalised, 3D boxes (centre, size) in metres, camera frame.

        ``classes`` are semantic ids 1-19, ``frame_indices`` the frames' positions in the split.
        """
        for b, target in enumerate(targets):
            found = [scores[b, :, None], classes[b, :, None], boxes_xyxy[b], boxes3d[b]]
            truth_xyxy = cxcywh_to_xyxy(target.boxes_cxcywh)
            truth = [target.classes[:, None], truth_xyxy, target.boxes3d_camera]
            counts = torch.tensor([float(frame_indices[b]), scores.shape[1], len(target)])
            for state, rows in (
                (self.frames, counts),
                (self.detections, torch.cat([part.float() for part in found], dim=1)),
                (self.objects, torch.cat([part.float() for part in truth], dim=1)),
            ):
                state.append(rows.detach().flatten().to(self.device))

    def compute(self) -> dict[str, float]:
        """``mAP``, ``AP50`` and ``recall3d_25``, in [0, 1]; 0 where there is no object at all."""
        frames = _split_frames(
            _rows(self.frames, 3), _rows(self.detections, 12), _rows(self.objects, 11)
        )
        mean_precision, precision_50 = average_precision(frames, self.image_size)
        recall = recall_3d(frames, iou_threshold=0.25, score_threshold=self.score_threshold)
        return {"mAP": mean_precision, "AP50": precision_50, "recall3d_25": recall}


#: By frame: detections [D, 12] (score, class, xyxy, 3D box) and objects [N, 11] (class, xyxy, 3D
#: box).
FrameBoxes = dict[int, tuple[np.ndarray, np.ndarray]]


def _rows(state: list[Tensor] | Tensor, width: int) -> np.ndarray:
    """A state, a list before it is synchronised and a tensor after, as a table."""
    if not len(state):
        return np.zeros((0, width), dtype=np.float32)
    flat = state if isinstance(state, Tensor) else torch.cat(state)
    return flat.cpu().numpy().reshape(-1, width)


def _split_frames(frames: np.ndarray, detections: np.ndarray, objects: np.ndarray) -> FrameBoxes:
    """Rows back to frames; of a frame that occurs twice the first stays."""
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
    found: FrameBoxes = {}
    for frame, its_detections, its_objects in parts:
        found.setdefault(frame, (its_detections, its_objects))
    return found


def average_precision(frames: FrameBoxes, image_size: tuple[int, int]) -> tuple[float, float]:
    """COCO's (mAP .50:.95, AP50) over the classes that the truth has: all areas, 100 detections."""
    height, width = image_size
    scale = np.array([width, height, width, height], dtype=np.float64)
    truth, found = [], []
    for frame, (detections, objects) in frames.items():
        truth += _annotations(frame, objects[:, 0], objects[:, 1:5] * scale)
        found += _annotations(frame, detections[:, 1], detections[:, 2:6] * scale, detections[:, 0])
    for number, annotation in enumerate(truth):
        annotation["id"] = number + 1  # COCO's matching takes 0 for "no match"
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
    """COCO's form of the boxes (pixels) of one frame."""
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


def recall_3d(frames: FrameBoxes, iou_threshold: float, score_threshold: float) -> float:
    """Share of objects that a detection of the same class finds, by IoU of the 3D boxes.

    As ``found_objects`` has it; 0 if there is no object.
    """
    matched = total = 0
    for detections, objects in frames.values():
        boxes, truth = torch.from_numpy(detections[:, 6:]), torch.from_numpy(objects[:, 5:])
        iou = box_iou(boxes[:, None], truth[None]).numpy()
        found = found_objects(
            *(detections[:, 0], detections[:, 1], objects[:, 0], iou),
            least_score=score_threshold,
            least_iou=iou_threshold,
        )
        total += len(found)
        matched += int(found.sum())
    return matched / total if total else 0.0
