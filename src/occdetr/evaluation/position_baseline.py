"""A baseline that ignores the image: the most frequent class at each voxel position."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Shaped, UInt8
from rich.progress import track

from occdetr.classes import NUM_CLASSES
from occdetr.data.frames import Frame
from occdetr.data.semantickitti import read_labels
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.geometry.voxels import GRID_SHAPE


class PositionBaseline:
    """Predicts for each voxel the class that was most frequent there in the training frames.

    Counts are uint16 (84 MB for the full grid), so it takes at most 65,535 frames.
    """

    def __init__(self, grid_shape: tuple[int, int, int] = GRID_SHAPE) -> None:
        self.counts = np.zeros((NUM_CLASSES, *grid_shape), dtype=np.uint16)
        self.num_frames = 0

    def update(self, labels: Shaped[np.ndarray, "x y z"]) -> None:
        """Count a training frame: classes 0-19; voxels with 255 are not counted.

        Raises ``OverflowError`` after 65,535 frames.
        """
        if self.num_frames == np.iinfo(np.uint16).max:
            raise OverflowError(f"the baseline counts at most {self.num_frames:,} frames")
        self.num_frames += 1
        for class_id in range(NUM_CLASSES):
            self.counts[class_id] += labels == class_id

    def predict(self) -> UInt8[np.ndarray, "x y z"]:
        """The most frequent class of each voxel: the lowest id of a tie, 0 if never labelled."""
        best = self.counts[0].copy()
        prediction = np.zeros(best.shape, dtype=np.uint8)
        for class_id in range(1, NUM_CLASSES):
            better = self.counts[class_id] > best
            prediction[better] = class_id
            np.maximum(best, self.counts[class_id], out=best)
        return prediction


def score_baseline(train: Sequence[Frame], held_out: Sequence[Frame]) -> dict[str, Any]:
    """``SemanticSceneCompletion`` of the baseline of ``train`` on the frames ``held_out``."""
    baseline, metric = PositionBaseline(), SemanticSceneCompletion()
    for frame in track(train, description="position baseline", transient=True):
        baseline.update(read_labels(frame))
    prediction = torch.from_numpy(baseline.predict())[None]
    for frame in held_out:
        metric.update(prediction, torch.from_numpy(read_labels(frame))[None])
    return metric.compute()
