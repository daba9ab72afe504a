"""From the network's output to what is asked of it: a grid and objects for each image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from occdetr.errors import InputError
from occdetr.geometry.boxes import cxcywh_to_xyxy
from occdetr.models.occdetr import OccupancyDETR
from occdetr.models.occupancy_probability import occupancy_probability
from occdetr.structures import DetectorOutput, OccupancyOutput, SceneBatch, SceneOutput

NOT_FINITE = (
    "the network's output is not finite: its weights are not, or its numbers overflow in this "
    "precision: use another checkpoint, or trainer.precision=32-true"
)


@dataclass
class Prediction:
    """One image: a grid of semantic classes, and the objects above the score threshold, best first.

    Attributes:
        grid: classes 0 (empty) to 19.
        boxes_xyxy: 2D boxes in pixels of the network's image; the centre of the first pixel is 0.
        boxes3d: centre and size in metres, in the camera frame.
        classes: semantic ids.
        scores: from 0 to 1.
        probability: that a voxel is occupied; None: it was not asked for.
    """

    grid: UInt8[np.ndarray, "x y z"]
    boxes_xyxy: Float[np.ndarray, "object 4"]
    boxes3d: Float[np.ndarray, "object 6"]
    classes: Int[np.ndarray, " object"]
    scores: Float[np.ndarray, " object"]
    probability: Float[np.ndarray, "x y z"] | None = None


def predict(model: OccupancyDETR, batch: SceneBatch, probability: bool = False) -> list[Prediction]:
    """Run the network on a batch. ``probability``: see ``Prediction``.

    Raises ``InputError`` if a number of its output is not finite.
    """
    output, grids = model.predict(batch)
    if found := frames_not_finite(batch.frame_ids, output.detections, output.occupancy):
        raise InputError(f"{', '.join(found)}: {NOT_FINITE}")
    predictions = decode(model, output, grids)
    if probability:
        values = occupancy_probability(model.fusion, output.occupancy).cpu().numpy()
        for prediction, own in zip(predictions, values, strict=True):
            prediction.probability = own
    return predictions


def frames_not_finite(
    frame_ids: Sequence[str],
    detections: DetectorOutput | None,
    occupancy: OccupancyOutput | None = None,
) -> list[str]:
    """Those frames of whose output a number is not finite."""
    parts: list[Tensor | None] = []
    if detections is not None:
        final = detections.final
        parts += [final.pred_logits, final.pred_boxes, final.pred_boxes3d]
    if occupancy is not None:
        voxels = None if occupancy.voxels is None else occupancy.voxels.logits
        parts += [occupancy.foreground_logits, voxels, occupancy.mask_logits]
    finite = [torch.isfinite(part).flatten(1).all(1) for part in parts if part is not None]
    every = torch.stack(finite).all(0).tolist()
    return [frame_id for frame_id, good in zip(frame_ids, every, strict=True) if not good]


def decode(
    model: OccupancyDETR, output: SceneOutput, grids: UInt8[Tensor, "batch x y z"]
) -> list[Prediction]:
    """What ``model.predict`` has returned, image by image."""
    return [_decode_frame(model, output, grid, frame) for frame, grid in enumerate(grids)]


def _decode_frame(
    model: OccupancyDETR, output: SceneOutput, grid: Tensor, frame: int
) -> Prediction:
    cells = grid.cpu().numpy()
    if output.detections is None:
        nothing = np.zeros((0, 10), np.float32)
        labels = np.zeros(0, np.int64)
        return Prediction(cells, nothing[:, :4], nothing[:, 4:], labels, nothing[:, 0])
    final = output.detections.final
    scores, classes = final.pred_logits[frame].float().sigmoid().max(-1)
    order = scores.argsort(descending=True)
    order = order[scores[order] > model.fusion.score_threshold]
    boxes = cxcywh_to_xyxy(final.pred_boxes[frame].float())[order].cpu().numpy()
    height, width = model.image_size
    return Prediction(
        grid=cells,
        boxes_xyxy=boxes * [width, height, width, height] - 0.5,
        boxes3d=final.pred_boxes3d[frame].float()[order].cpu().numpy(),
        classes=model.foreground_classes[classes][order].cpu().numpy(),
        scores=scores[order].cpu().numpy(),
    )
