"""Semantic scene completion as SemanticKITTI's benchmark scores it: mIoU, and IoU of "occupied".

Pure functions do the arithmetic; a thin torchmetrics class counts over batches and ranks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor
from torchmetrics import Metric

from occdetr.classes import CLASS_NAMES, IGNORE, NUM_CLASSES
from occdetr.evaluation.distance import BANDS, band_slices

# The two constants of the official evaluator: without them the last digits differ.
_IOU_EPSILON = 1e-15
_COMPLETION_EPSILON = float(np.finfo(np.float32).eps)


def confusion_matrix(
    prediction: UInt8[Tensor, "*grid"], target: UInt8[Tensor, "*grid"]
) -> Int[Tensor, "class class"]:
    """Number of voxels by predicted class (rows) and true class (columns), int64.

    Voxels whose target is 255 are not counted. Raises ``ValueError`` if the shapes differ, or on
    any other value above 19.
    """
    if prediction.shape != target.shape:
        raise ValueError(f"prediction {prediction.shape} and target {target.shape} differ in shape")
    # One bin per pair of bytes, so that 255 is a column to drop instead of a mask to apply.
    pairs = prediction.flatten().to(torch.int32).mul_(256).add_(target.flatten())
    counts = torch.bincount(pairs, minlength=256 * NUM_CLASSES)
    table = torch.nn.functional.pad(counts, (0, -len(counts) % 256)).view(-1, 256)
    evaluated = table[:, :IGNORE].sum()
    confusion = table[:NUM_CLASSES, :NUM_CLASSES]
    if evaluated != confusion.sum():
        raise ValueError(
            f"prediction must hold 0-{NUM_CLASSES - 1}, target 0-{NUM_CLASSES - 1} or {IGNORE}"
        )
    return confusion


def completion_scores(confusion: Int[np.ndarray, "class class"]) -> dict[str, Any]:
    """SemanticKITTI's scores of a confusion matrix (rows prediction, columns truth).

    ``mIoU``: mean over classes 1-19, where an absent class counts 0. ``mIoU_present``: mean over
    the classes with voxels in the truth. ``IoU``, ``precision``, ``recall``: of "occupied".
    ``per_class``: IoU by class name. All are in [0, 1] and equal the floating-point results of
    ``evaluate_completion.py`` of the SemanticKITTI API exactly.
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

    The state is ``bands`` (int64 [3, 20, 20]: band of distance, prediction, truth) and
    ``num_frames``. A frame that is passed twice counts twice, so the sampler must not pad.

    Examples:
        >>> import torch
        >>> from occdetr.evaluation.completion import SemanticSceneCompletion
        >>> target = torch.zeros(1, 256, 256, 32, dtype=torch.uint8)
        >>> target[:, :, :, 0] = 9  # road
        >>> prediction = target.clone()
        >>> prediction[:, 128:] = 0
        >>> metric = SemanticSceneCompletion()
        >>> metric.update(prediction, target)
        >>> scores = metric.compute()
        >>> scores["per_class"]["road"], scores["by_distance"]["0-12.8 m"]["IoU"]
        (0.5, 1.0)
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
    def confusion(self) -> Int[Tensor, "class class"]:
        """The confusion matrix over all distances: rows prediction, columns truth."""
        return self.bands.sum(0)

    def update(
        self, prediction: UInt8[Tensor, "batch x y z"], target: UInt8[Tensor, "batch x y z"]
    ) -> None:
        """Count a batch: ``prediction`` 0-19, ``target`` 0-19 or 255 (not evaluated)."""
        parts = [(prediction[:, band], target[:, band]) for band in band_slices()]
        self.bands += torch.stack([confusion_matrix(*part) for part in parts]).to(self.bands.device)
        self.num_frames += len(prediction)

    def compute(self) -> dict[str, Any]:
        """The scores of ``completion_scores`` over the whole grid, and further keys:

        ``num_frames``, ``by_distance`` (the scores of each of ``BANDS``) and ``confusion`` (the
        counts ``bands`` as nested lists).
        """
        bands = self.bands.cpu().numpy()
        by_distance = [completion_scores(confusion) for confusion in bands]
        return {
            **completion_scores(bands.sum(axis=0)),
            "num_frames": int(self.num_frames),
            "by_distance": dict(zip(BANDS, by_distance, strict=True)),
            "confusion": bands.tolist(),
        }
