"""Near and far: bands of distance, and which objects are found in each.

Distance is the x of the grid frame, metres ahead of the LiDAR: of a voxel's centre, of the centre
of an object's box. It is what a single picture tells least of, objects are sorted by it, and its
bands divide the grid without a rest. (The nested volumes of SSCBench and VoxFormer, 12.8 x 12.8,
25.6 x 25.6 and 51.2 x 51.2 m, also leave out what is near but to the side.)
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torchmetrics import Metric

from occdetr.classes import CLASS_NAMES, NUM_CLASSES
from occdetr.geometry.boxes import box_iou, xyxy_to_cxcywh
from occdetr.geometry.voxels import VOXEL_SIZE
from occdetr.structures import SceneTarget

#: Inner borders of the bands, metres.
BORDERS = (12.8, 25.6)
BANDS = ("0-12.8 m", "12.8-25.6 m", "25.6-51.2 m")


def band_slices() -> list[slice]:
    """The voxels of each band along x; the last band has all that is left."""
    edges = [0, *(round(border / VOXEL_SIZE) for border in BORDERS), None]
    return [slice(start, end) for start, end in itertools.pairwise(edges)]


def band_of(x: Float[Tensor, " point"]) -> Int[Tensor, " point"]:
    """The band of places x metres ahead; a place on a border belongs to the farther one."""
    borders = torch.tensor(BORDERS, dtype=x.dtype, device=x.device)
    return torch.bucketize(x.contiguous(), borders, right=True)


FOUND_SCORE = 0.3  # of a detection that can find an object, whatever fusion writes


def found_objects(
    scores: Float[np.ndarray, " detection"],
    classes: Shaped[np.ndarray, " detection"],
    object_classes: Shaped[np.ndarray, " object"],
    iou: Float[np.ndarray, "detection object"],
    least_score: float,
    least_iou: float,
) -> Bool[np.ndarray, " object"]:
    """Which objects of a frame a detection of the same class finds.

    One to one, greedily: each detection of at least ``least_score``, best first, takes the free
    object it overlaps most, if by at least ``least_iou``.
    """
    found = np.zeros(len(object_classes), dtype=bool)
    sure = np.flatnonzero(scores >= least_score)
    sure = sure[np.argsort(-scores[sure], kind="stable")]
    iou = np.where(classes[:, None] == object_classes[None], iou, -1.0)
    for row in iou[sure] if len(found) else ():
        best = np.where(found, -1.0, row).argmax()
        found[best] |= row[best] >= least_iou
    return found


class DetectionRecall(Metric):
    """Objects, and those found, by class and distance: integers, summed over all ranks.

    Found means by ``found_objects`` at a score of ``score_threshold``: once by the image boxes at
    an IoU of 0.5, once by the 3D boxes at 0.25. Feed every frame once. ``counts`` is int64
    [objects | found in 2D | found in 3D, class, band].
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
        """Take a batch, in the form that ``DetectionMetric`` takes."""
        for b, target in enumerate(targets):
            plane = box_iou(xyxy_to_cxcywh(boxes_xyxy[b])[:, None], target.boxes_cxcywh[None])
            space = box_iou(boxes3d[b][:, None], target.boxes3d_camera[None])
            score, kind, true = (
                part.cpu().numpy() for part in (scores[b], classes[b], target.classes)
            )
            found = [
                found_objects(score, kind, true, iou.cpu().numpy(), self.score_threshold, least)
                for iou, least in ((plane, 0.5), (space, 0.25))
            ]
            band = band_of(target.boxes3d_grid[:, 0]).cpu().numpy()
            for row, those in enumerate([np.ones(len(target), dtype=bool), *found]):
                place = true[those] * len(BANDS) + band[those]
                counts = np.bincount(place, minlength=NUM_CLASSES * len(BANDS))
                counts = torch.from_numpy(counts).view(NUM_CLASSES, len(BANDS))
                self.counts[row] += counts.to(self.counts.device)

    def compute(self) -> dict[str, Any]:
        """{class: {band: {"objects", "found2d_50", "found3d_25"}}} of the classes with objects."""
        counts = self.counts.cpu().numpy()
        keys = ("objects", "found2d_50", "found3d_25")
        return {
            CLASS_NAMES[index]: {
                band: dict(zip(keys, counts[:, index, b].tolist(), strict=True))
                for b, band in enumerate(BANDS)
            }
            for index in np.flatnonzero(counts[0].sum(1)).tolist()
        }
