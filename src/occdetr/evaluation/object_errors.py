"""The outcome of every object: missed, wrong class, wrong place, wrong shape, or right.

And which of these causes each wrong voxel of a foreground class.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torchmetrics import Metric

from occdetr.classes import CLASS_NAMES, IGNORE, NUM_CLASSES
from occdetr.geometry.boxes import box_iou
from occdetr.structures import SceneTarget

PLANE_IOU = 0.5  # of image boxes: a detection and an object that are the same
SPACE_IOU = 0.25  # of enlarged 3D boxes: they are in the same place
SHAPE_IOU = 0.5  # of the cells in a box: the object has the right shape

#: Outcomes of an object; the first that applies, in this order. Missed: no detection matches it.
#: Wrong class. Wrong place: matched by the image boxes, but the enlarged 3D boxes have an IoU below
#: ``SPACE_IOU``. Wrong shape: its predicted and true cells in its box have an IoU below
#: ``SHAPE_IOU``. Right. The outcome of a detection that matches no object is "false".
OUTCOMES = ("missed", "wrong class", "wrong place", "wrong shape", "right", "false")
MISSED, WRONG_CLASS, WRONG_PLACE, WRONG_SHAPE, RIGHT, FALSE = range(6)

#: Causes of a wrong voxel: the outcome of its object or detection ("wrong shape" if that is right
#: as a whole), or "background" where no object is concerned. In the order of ``OUTCOMES``, with the
#: background in place of "right".
CAUSES = ("missed", "wrong class", "wrong place", "wrong shape", "background", "false")
BY_BACKGROUND = 4


@dataclass
class Written:
    """The detections of one frame that fusion writes, best first (it is written last, on top).

    ``classes`` are semantic ids, ``boxes3d`` the enlarged boxes in the grid frame (metres),
    ``logits`` the occupancy of their cells. ``objects``: the true object matched to each one, -1 if
    there is none.
    """

    classes: Int[Tensor, " written"]
    boxes3d: Float[Tensor, "written 6"]
    logits: Float[Tensor, "written n n n"]
    objects: Int[Tensor, " written"]

    def __len__(self) -> int:
        return len(self.classes)

    def of_objects(self, count: int) -> Int[Tensor, " object"]:
        """The detection matched to each of ``count`` true objects, -1 if it was missed."""
        found = torch.full((count,), -1, dtype=torch.long, device=self.objects.device)
        those = (self.objects >= 0).nonzero().squeeze(1)
        found[self.objects[those]] = those
        return found


def match_objects(
    classes: Int[Tensor, " written"],
    boxes_cxcywh: Float[Tensor, "written 4"],
    boxes3d: Float[Tensor, "written 6"],
    target: SceneTarget,
    true_boxes3d: Float[Tensor, "object 6"],
) -> Int[Tensor, " written"]:
    """The object matched to each detection, -1 for a false one; one to one.

    A pair can match, whatever the classes, if the image boxes (``PLANE_IOU``) or the enlarged 3D
    boxes in the grid frame (``SPACE_IOU``) overlap enough. (Boxes that are not enlarged would not
    do: a pole's overlap too little at an error of 12 cm.) The matching has as many pairs as
    possible, then as many of the same class as possible, then the largest overlap.
    """
    plane = box_iou(boxes_cxcywh[:, None], target.boxes_cxcywh[None])
    space = box_iou(boxes3d[:, None], true_boxes3d[None])
    near = (plane >= PLANE_IOU) | (space >= SPACE_IOU)
    same = classes[:, None] == target.classes[None]
    gain = near * (4 + 1.0 * same + (plane + space) / 2)
    rows, columns = linear_sum_assignment(gain.cpu().numpy(), maximize=True)
    rows, columns = (torch.as_tensor(part, device=classes.device) for part in (rows, columns))
    kept = near[rows, columns]
    objects = torch.full_like(classes, -1)
    objects[rows[kept]] = columns[kept]
    return objects


def object_outcomes(
    written: Written,
    target: SceneTarget,
    true_boxes3d: Float[Tensor, "object 6"],
    shape_iou: Float[Tensor, " written"],
) -> Int[Tensor, " object"]:
    """The outcome of each true object, as an index into ``OUTCOMES``.

    ``shape_iou``: the IoU of the predicted and the true cells of each detection.
    """
    index = written.of_objects(len(target))
    missed = index < 0
    if not len(written):
        return torch.full_like(target.classes, MISSED)
    own = index.clamp(min=0)
    overlap = box_iou(written.boxes3d[own], true_boxes3d)
    outcomes = torch.where(shape_iou[own] < SHAPE_IOU, WRONG_SHAPE, RIGHT)
    outcomes = torch.where(overlap < SPACE_IOU, WRONG_PLACE, outcomes)
    outcomes = torch.where(written.classes[own] != target.classes, WRONG_CLASS, outcomes)
    return torch.where(missed, MISSED, outcomes)


@dataclass
class FrameErrors:
    """What ``ObjectErrors`` counts of one frame.

    ``outcomes``: of each true object. ``owner``: 1 + the true object of each voxel, ``writer``: 1 +
    the detection written there (an index into ``written``); 0 where there is none.
    """

    written: Written
    target: SceneTarget
    outcomes: Int[Tensor, " object"]
    owner: Int[Tensor, "x y z"]
    writer: Int[Tensor, "x y z"]


class ObjectErrors(Metric):
    """Counts of outcomes and of wrong voxels, by class; integers, summed over all ranks.

    ``objects`` [class, outcome]: by the true class, false detections by the predicted one. ``lost``
    [class, cause]: voxels of that class that are predicted as another. ``invented`` [class, cause]:
    voxels predicted as that class that are of another. A voxel of one foreground class predicted as
    another counts in both. Only ``foreground_classes`` are counted.
    """

    full_state_update = False
    objects: Tensor
    lost: Tensor
    invented: Tensor

    def __init__(self, foreground_classes: Int[Tensor, " class"]) -> None:
        super().__init__()
        self.foreground = torch.zeros(256, dtype=torch.bool)
        self.foreground[foreground_classes.cpu()] = True
        for name in ("objects", "lost", "invented"):
            zeros = torch.zeros(NUM_CLASSES, len(OUTCOMES), dtype=torch.int64)
            self.add_state(name, default=zeros, dist_reduce_fx="sum")

    def update(
        self,
        frame: FrameErrors,
        prediction: UInt8[Tensor, "x y z"],
        labels: UInt8[Tensor, "x y z"],
    ) -> None:
        """Count a frame and its fused prediction."""
        false = frame.written.objects < 0
        self.objects += _count(frame.target.classes, frame.outcomes).to(self.device)
        self.objects += _count(frame.written.classes[false], FALSE).to(self.device)
        causes = torch.where(frame.outcomes == RIGHT, WRONG_SHAPE, frame.outcomes)
        background = torch.full((1,), BY_BACKGROUND, device=causes.device)
        of_owner = torch.cat([background, causes])
        of_writer = torch.where(false, FALSE, of_owner[frame.written.objects + 1])
        of_writer = torch.cat([background, of_writer])
        wrong = (labels != IGNORE) & (prediction != labels)
        foreground = self.foreground.to(labels.device)
        for state, classes, place, cause in (
            (self.lost, labels, frame.owner, of_owner),
            (self.invented, prediction, frame.writer, of_writer),
        ):
            which = wrong & foreground[classes.long()]
            state += _count(classes[which].long(), cause[place[which].long()]).to(self.device)

    def compute(self) -> dict[str, Any]:
        """{"objects": {class: {outcome: n}}, "lost" and "invented": {class: {cause: n}}}."""
        return {
            "objects": _by_name(self.objects, OUTCOMES),
            "lost": _by_name(self.lost, CAUSES),
            "invented": _by_name(self.invented, CAUSES),
        }


def _count(classes: Int[Tensor, " n"], kinds: Tensor | int) -> Int[Tensor, "class kind"]:
    """The number of times that each class has each kind."""
    place = classes * len(OUTCOMES) + kinds
    counts = torch.bincount(place, minlength=NUM_CLASSES * len(OUTCOMES))
    return counts.view(NUM_CLASSES, len(OUTCOMES))


def _by_name(counts: Tensor, names: tuple[str, ...]) -> dict[str, dict[str, int]]:
    """The rows of the classes that have any count."""
    return {
        CLASS_NAMES[index]: dict(zip(names, counts[index].tolist(), strict=True))
        for index in counts.sum(1).nonzero().squeeze(1).tolist()
    }


def occupied_iou(
    predicted: Bool[Tensor, "*n cell"],
    true: Bool[Tensor, "*n cell"],
    known: Bool[Tensor, "*n cell"],
) -> Float[Tensor, " *n"]:
    """IoU over the known cells; 0 where nothing is occupied."""
    both = (predicted & true & known).sum(-1)
    either = ((predicted | true) & known).sum(-1)
    return both / either.clamp(min=1)
