"""What became of every object: found, missed, of the wrong class, in the wrong place or shape.

And which of these is to blame for every wrong voxel of a foreground class.
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

#: What an object, or a detection, can come to; the first that applies, in this order:
#: missed (nothing matches it), wrong class, wrong place (matched in the image, but the enlarged 3D
#: boxes overlap by less than ``SPACE_IOU``), wrong shape (its cells and the true ones in its box
#: overlap by less than ``SHAPE_IOU``), right; a detection that matches no object is false.
FATES = ("missed", "wrong class", "wrong place", "wrong shape", "right", "false")
MISSED, WRONG_CLASS, WRONG_PLACE, WRONG_SHAPE, RIGHT, FALSE = range(6)

#: What a wrong voxel can come from: the fate of its object or detection, where the shape of an
#: object that is right as a whole has the rest; the background where no object is concerned.
CAUSES = ("missed", "wrong class", "wrong place", "wrong shape", "background", "false")
BACKGROUND = 4


@dataclass
class Written:
    """The objects of one frame that fusion writes, the last one first: the best stand on top.

    ``classes`` are semantic ids, ``boxes3d`` the enlarged boxes in the grid frame (metres),
    ``logits`` the occupancy of their cells. ``objects``: the true object that each one stands for,
    -1 where there is none.
    """

    classes: Int[Tensor, " written"]
    boxes3d: Float[Tensor, "written 6"]
    logits: Float[Tensor, "written n n n"]
    objects: Int[Tensor, " written"]

    def __len__(self) -> int:
        return len(self.classes)

    def of_objects(self, count: int) -> Int[Tensor, " object"]:
        """For each of ``count`` true objects the one written for it, -1 where it was missed."""
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
    """The object that each detection stands for, -1 for a false one; one to one.

    They match, whatever their classes, by the image boxes (``PLANE_IOU``) or by the enlarged 3D
    boxes (``SPACE_IOU``), grid frame: bare boxes of a pole no longer overlap enough 12 cm apart.
    As many as possible match; among the ways to do so, those of one class and of most overlap.
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


def object_fates(
    written: Written,
    target: SceneTarget,
    true_boxes3d: Float[Tensor, "object 6"],
    shape_iou: Float[Tensor, " written"],
) -> Int[Tensor, " object"]:
    """The fate of each true object, as an index into ``FATES``.

    ``shape_iou``: of the cells that each object written says are occupied, with the true ones.
    """
    index = written.of_objects(len(target))
    missed = index < 0
    if not len(written):
        return torch.full_like(target.classes, MISSED)
    own = index.clamp(min=0)
    overlap = box_iou(written.boxes3d[own], true_boxes3d)
    fates = torch.where(shape_iou[own] < SHAPE_IOU, WRONG_SHAPE, RIGHT)
    fates = torch.where(overlap < SPACE_IOU, WRONG_PLACE, fates)
    fates = torch.where(written.classes[own] != target.classes, WRONG_CLASS, fates)
    return torch.where(missed, MISSED, fates)


class ObjectErrors(Metric):
    """Counts of fates and of wrong voxels, by class; integers, summed over all ranks.

    ``objects`` [class, fate]: by the true class, false detections by the predicted one. ``lost``
    [class, cause]: voxels of that class that are predicted to be anything else, and ``invented``:
    voxels predicted of that class that are none. A voxel of one foreground class taken for another
    is both. Only ``foreground_classes`` count.
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
            zeros = torch.zeros(NUM_CLASSES, len(FATES), dtype=torch.int64)
            self.add_state(name, default=zeros, dist_reduce_fx="sum")

    def update(
        self,
        written: Written,
        target: SceneTarget,
        fates: Int[Tensor, " object"],
        prediction: UInt8[Tensor, "x y z"],
        labels: UInt8[Tensor, "x y z"],
        owner: Int[Tensor, "x y z"],
        writer: Int[Tensor, "x y z"],
    ) -> None:
        """Count a frame; ``owner``: 1 + the true object of each voxel, ``writer``: 1 + the object
        written there (index into ``written``), 0 where there is none."""
        false = written.objects < 0
        self.objects += _count(target.classes, fates).to(self.device)
        self.objects += _count(written.classes[false], FALSE).to(self.device)
        causes = torch.where(fates == RIGHT, WRONG_SHAPE, fates)
        nobody = torch.full((1,), BACKGROUND, device=causes.device)
        of_owner = torch.cat([nobody, causes])
        of_writer = torch.where(false, FALSE, of_owner[written.objects + 1])
        of_writer = torch.cat([nobody, of_writer])
        wrong = (labels != IGNORE) & (prediction != labels)
        foreground = self.foreground.to(labels.device)
        for state, classes, place, cause in (
            (self.lost, labels, owner, of_owner),
            (self.invented, prediction, writer, of_writer),
        ):
            which = wrong & foreground[classes.long()]
            state += _count(classes[which].long(), cause[place[which].long()]).to(self.device)

    def compute(self) -> dict[str, Any]:
        """{"objects": {class: {fate: count}}, "lost": {class: {cause: count}}, "invented": ...}."""
        return {
            "objects": _by_name(self.objects, FATES),
            "lost": _by_name(self.lost, CAUSES),
            "invented": _by_name(self.invented, CAUSES),
        }


def _count(classes: Int[Tensor, " n"], kinds: Tensor | int) -> Int[Tensor, "20 kind"]:
    """How often each class came with each kind."""
    place = classes * len(FATES) + kinds
    counts = torch.bincount(place, minlength=NUM_CLASSES * len(FATES))
    return counts.view(NUM_CLASSES, len(FATES))


def _by_name(counts: Tensor, names: tuple[str, ...]) -> dict[str, dict[str, int]]:
    """Rows of classes that have any."""
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
