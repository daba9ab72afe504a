"""The baseline that any model has to beat: the class most frequent at each voxel position."""

from __future__ import annotations

import numpy as np
from jaxtyping import Shaped, UInt8

from occdetr.classes import NUM_CLASSES
from occdetr.geometry.voxels import GRID_SHAPE


class PositionBaseline:
    """Predicts for each voxel the class it had most often in training, whatever the picture.

    Counts in uint16 (84 MB for the full grid), so it takes at most 65,535 frames.
    """

    def __init__(self, grid_shape: tuple[int, int, int] = GRID_SHAPE) -> None:
        self.counts = np.zeros((NUM_CLASSES, *grid_shape), dtype=np.uint16)
        self.num_frames = 0

    def update(self, labels: Shaped[np.ndarray, "x y z"]) -> None:
        """Count a training frame; voxels with 255 do not count."""
        if self.num_frames == np.iinfo(np.uint16).max:
            raise OverflowError(f"the baseline counts at most {self.num_frames:,} frames")
        self.num_frames += 1
        for class_id in range(NUM_CLASSES):
            self.counts[class_id] += labels == class_id

    def predict(self) -> UInt8[np.ndarray, "x y z"]:
        """The most frequent class per voxel: of equals the lowest id, 0 where never labelled."""
        best = self.counts[0].copy()
        prediction = np.zeros(best.shape, dtype=np.uint8)
        for class_id in range(1, NUM_CLASSES):
            better = self.counts[class_id] > best
            prediction[better] = class_id
            np.maximum(best, self.counts[class_id], out=best)
        return prediction
