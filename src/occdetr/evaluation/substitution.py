"""One frame of a prediction, fused again after some of its parts are replaced by the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection

import torch
from jaxtyping import Float, Int, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from occdetr.classes import IGNORE
from occdetr.evaluation.object_errors import (
    Written,
    match_objects,
    object_outcomes,
    occupied_iou,
)
from occdetr.evaluation.upper_bound import perfect_background, perfect_cells
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.losses.targets import SceneTruth, resample_objects
from occdetr.models.fusion import write_voxels
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import (
    OccupancyOutput,
    SceneOutput,
    SceneTarget,
    Slots,
)

#: The parts, in the order in which they are substituted together, and what is then true.
PREDICTION_PARTS = {
    "detections": "which objects there are, and of which class",
    "3D boxes": "where the objects found are",
    "object occupancy": "which cells of its box an object found fills",
    "background occupancy": "which voxels the background fills",
    "background classes": "which class the voxels have that the background fills",
}
OBJECT_PARTS = frozenset(tuple(PREDICTION_PARTS)[:3])
BACKGROUND_PARTS = frozenset(PREDICTION_PARTS) - OBJECT_PARTS


class SubstitutedFrame:
    """One frame of a prediction; ``fuse`` substitutes the truth for some of ``PREDICTION_PARTS``.

    detections
        The objects are the true ones, as many as there are slots, the nearest first and on top,
        with their true classes; false detections are removed. An object that was detected
        (``match_objects``) keeps its predicted box and cells. One that was missed gets its true box
        and cells, since there are no predicted ones.
    3D boxes
        Detections matched to an object get its true (enlarged) box. Their cells and classes are
        kept, and so are false detections. If cells make up for a wrong box, this lowers the score.
    object occupancy
        The cells of detections matched to an object are the object's, within the predicted box;
        what lies outside of the box stays lost. False detections are kept.
    background occupancy
        The background fills the voxels that are its own, as far as K allows. Their class is the
        mask head's prediction; voxels that were no candidates get the class of the nearest voxel
        that was filled.
    background classes
        Filled voxels of the background have their true class. Those that are empty in truth, or
        belong to an object, keep the predicted class.

    With all of them the result is the variant "all" of ``UpperBound``. Unknown voxels stay as they
    are.
    """

    def __init__(
        self,
        model: OccupancyDETR,
        criterion: OccupancyCriterion,
        truth: SceneTruth,
        output: SceneOutput,
        index: int,
    ) -> None:
        self.model, self.criterion, self.output, self.index = model, criterion, output, index
        self.truth = truth.frame(index)
        self.target: SceneTarget = self.truth.targets[0]
        self.true_boxes = model.slots.enlarge(self.target.boxes3d_grid)
        self.written = self._written()
        self._objects: dict[frozenset[str], Tensor | None] = {}
        self._background: dict[frozenset[str], Tensor | None] = {}

    def fuse(self, parts: Collection[str]) -> UInt8[Tensor, "1 x y z"]:
        """The fused grid with the truth in place of ``parts``."""
        objects = _cached(self._objects, self._fuse_objects, OBJECT_PARTS.intersection(parts))
        background = _cached(
            self._background, self._fuse_background, BACKGROUND_PARTS.intersection(parts)
        )
        if objects is None or background is None:
            grid = objects if background is None else background
            assert grid is not None
            return grid
        return torch.where(objects > 0, objects, background)

    # ------------------------------------------------------------------ objects

    def _written(self) -> Written | None:
        """The detections that fusion writes, matched to the true objects."""
        detections, occupancy = self.output.detections, self.output.occupancy
        slots, logits, index = occupancy.slots, occupancy.foreground_logits, self.index
        if detections is None or slots is None or logits is None:
            return None
        kept = slots.scores[index] > self.model.fusion.score_threshold
        classes, boxes3d = slots.classes[index, kept], slots.boxes3d[index, kept].float()
        plane = detections.final.pred_boxes[index, slots.query_indices[index, kept]].float()
        objects = match_objects(classes, plane, boxes3d, self.target, self.true_boxes)
        return Written(classes, boxes3d, logits[index, kept].float(), objects)

    def _fuse_objects(self, parts: frozenset[str]) -> UInt8[Tensor, "1 x y z"] | None:
        """The objects alone, with the truth for ``parts``; None in a network without objects."""
        if self.written is None:
            return None
        return self._write(self._replace(self.written, parts))

    def _write(self, written: Written) -> UInt8[Tensor, "1 x y z"]:
        """Fuse these objects alone, all of them, the first one on top."""
        scores = torch.full((1, len(written)), torch.inf, device=written.classes.device)
        indices = torch.zeros_like(scores, dtype=torch.long)
        used = torch.ones_like(scores, dtype=torch.bool)
        slots = Slots(indices, scores, written.classes[None], written.boxes3d[None], used)
        return self.model.fusion(OccupancyOutput(slots, written.logits[None], [], None, None))

    def _replace(self, written: Written, parts: frozenset[str]) -> Written:
        if "detections" in parts:
            written = self._true_detections(written)
        found = (written.objects >= 0).nonzero().squeeze(1)
        objects = written.objects[found]
        if "3D boxes" in parts:
            boxes3d = written.boxes3d.index_copy(0, found, self.true_boxes[objects])
            written = dataclasses.replace(written, boxes3d=boxes3d)
        if "object occupancy" in parts:
            logits = self._true_logits(objects, written.boxes3d[found])
            logits = written.logits.index_copy(0, found, logits)
            written = dataclasses.replace(written, logits=logits)
        return written

    def _true_detections(self, written: Written) -> Written:
        """The nearest objects: as detected, or the true ones if missed."""
        count = min(len(self.target), self.model.slots.num_slots)
        source = written.of_objects(len(self.target))[:count]
        missed, found = (source < 0).nonzero().squeeze(1), (source >= 0).nonzero().squeeze(1)
        boxes3d = self.true_boxes[:count].index_copy(0, found, written.boxes3d[source[found]])
        logits = written.logits.new_empty(count, *written.logits.shape[1:])
        logits[found] = written.logits[source[found]]
        logits[missed] = self._true_logits(missed, boxes3d[missed])
        objects = torch.arange(count, device=source.device)
        return Written(self.target.classes[:count], boxes3d, logits, objects)

    def _true_logits(
        self, objects: Int[Tensor, " pair"], boxes3d: Float[Tensor, "pair 6"]
    ) -> Float[Tensor, "pair n n n"]:
        """True logits of the cells of ``objects`` in these boxes; one at a time, to save memory."""
        side = self.model.occupancy_decoder.objects.cells
        resampling = self.criterion.objects.resampling
        cells = [boxes3d.new_zeros(0, side, side, side)]
        for pair in zip(objects.split(1), boxes3d.split(1), strict=True) if len(objects) else ():
            cells.append(perfect_cells(self.model, self.truth, *pair, resampling))
        return torch.cat(cells).logit()

    def outcomes(self) -> Int[Tensor, " object"]:
        """The outcome of each true object, as an index into ``OUTCOMES``."""
        assert self.written is not None
        written, threshold = self.written, self.model.fusion.foreground_threshold
        side = written.logits.shape[-1]
        overlap = written.boxes3d.new_zeros(len(written))
        for index in (written.objects >= 0).nonzero().squeeze(1).split(1):
            objects, boxes3d = written.objects[index], written.boxes3d[index]
            owner, labels = self.truth.owner[0], self.truth.labels[0]
            resampling = self.criterion.objects.resampling
            true, known = resample_objects(owner, labels, objects, boxes3d, side, resampling)
            predicted = written.logits[index].sigmoid().flatten(1)
            overlap[index] = occupied_iou(predicted > threshold, true > threshold, known > 0)
        return object_outcomes(written, self.target, self.true_boxes, overlap)

    def writer(self) -> Int[Tensor, "x y z"]:
        """1 + the index of the detection written at each voxel, 0 where there is none; for up to
        255 detections, as fusion writes bytes."""
        assert self.written is not None
        numbers = torch.arange(1, len(self.written) + 1, device=self.written.classes.device)
        return self._write(dataclasses.replace(self.written, classes=numbers))[0].to(torch.int16)

    # --------------------------------------------------------------- background

    def _fuse_background(self, parts: frozenset[str]) -> UInt8[Tensor, "1 x y z"] | None:
        """The background alone, with the truth for ``parts``; None in a network without one."""
        if self.output.occupancy.voxels is None:
            return None
        coordinates, classes = self._filled("background occupancy" in parts)
        if "background classes" in parts:
            answered = self.criterion.background_classes(self.truth)[0]
            true = answered.masked_fill(answered == IGNORE, 0)[tuple(coordinates.T)]
            classes = torch.where(true > 0, true, classes)
        return write_voxels(coordinates[None], classes[None])

    def _filled(self, true: bool) -> tuple[Int[Tensor, "voxel 3"], UInt8[Tensor, " voxel"]]:
        """The voxels that the background fills, and the classes that the mask head predicts."""
        voxels, mask_logits = self.output.occupancy.voxels, self.output.occupancy.mask_logits
        assert voxels is not None
        assert mask_logits is not None
        candidates, frame = voxels.coordinates[self.index], slice(self.index, self.index + 1)
        written = self.model.fusion.background_classes(voxels.logits[frame], mask_logits[frame])[0]
        filled = written > 0
        if not true:
            return candidates[filled], written[filled]
        classes = self.model.fusion.mask_classes[mask_logits[self.index].argmax(0)]
        classes = torch.where(filled, written, classes)
        limits = ("objects", "K", "background cells")
        grid = perfect_background(self.model, self.criterion, self.truth, limits)
        coordinates = grid[0].nonzero()
        own = write_voxels(candidates[None], classes[None])[0][tuple(coordinates.T)]
        known = filled if filled.any() else torch.ones_like(filled)
        own[own == 0] = classes[known][nearest(candidates[known], coordinates[own == 0])]
        return coordinates, own


def nearest(
    voxels: Int[Tensor, "voxel 3"], others: Int[Tensor, "other 3"]
) -> Int[Tensor, " other"]:
    """The index of the nearest of ``voxels`` for each of ``others``.

    Coordinates are counted from 1 for it: if most are 0, SciPy divides them at the smallest number
    above 0, which does not exist where denormal numbers are zero, as they are in a run, and fills
    the stack.
    """
    tree = KDTree(1 + voxels.cpu().numpy())
    return torch.as_tensor(tree.query(1 + others.cpu().numpy())[1], device=voxels.device)


def _cached(
    made: dict[frozenset[str], Tensor | None],
    make: Callable[[frozenset[str]], Tensor | None],
    parts: frozenset[str],
) -> Tensor | None:
    """``make(parts)``, cached in ``made``."""
    if parts not in made:
        made[parts] = make(parts)
    return made[parts]
