"""Background voxels and foreground objects -> the full semantic grid (paper III-C, last step)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int, Num
from torch import Tensor, nn

from occdetr.classes import check_classes
from occdetr.errors import SHARE, check_ranges
from occdetr.geometry.voxels import GRID_SHAPE
from occdetr.models.object_writer import Interpolation, write_objects
from occdetr.structures import OccupancyOutput

MEMORY = 0.99  # share of the sums that a training step keeps
LEAST_THRESHOLD = 0.05  # of a class; below it lie classes that were hardly seen, and noise


class ClassThresholds(nn.Module):
    """The probability above which a voxel is written as a class: half of the class's dice.

    This is best for the dice of a class, and so for its IoU, where probabilities are true (Lipton
    et al., Optimal Thresholding of Classifiers to Maximize F1 Measure, 2014). Where a surface is
    known to a few voxels only, as that of a wall, no voxel may be more probable than one in five,
    and a threshold for all classes writes none.

    The dice of occupancy times class are ratios of sums over the last training steps
    (``observe``), on several ranks of each one's own frames. ``initial``: the threshold of all
    classes before the first step.
    """

    hits: Tensor
    total: Tensor

    def __init__(self, num_classes: int, initial: float) -> None:
        super().__init__()
        self.initial = initial
        self.register_buffer("hits", torch.zeros(num_classes))
        self.register_buffer("total", torch.zeros(num_classes))

    def forward(self) -> Float[Tensor, " class"]:
        known = self.total > 0
        half_dice = self.hits / torch.where(known, self.total, 1.0)
        return torch.where(known, half_dice.clamp(min=LEAST_THRESHOLD), self.initial)

    @torch.no_grad()
    def observe(
        self, hits: Float[Tensor, "batch class"], total: Float[Tensor, "batch class"]
    ) -> None:
        """Count a training step: probability in true voxels; probability in all voxels, plus the
        number of true ones. A step whose sums are not finite does not count."""
        finite = torch.isfinite(hits.sum() + total.sum())
        for kept, new in ((self.hits, hits), (self.total, total)):
            kept.copy_(torch.where(finite, MEMORY * kept + new.sum(0), kept))


class Fusion(nn.Module):
    """Writes background voxels by their class, then the objects over them, higher scores last.

    ``mask_classes``: the semantic id of each class of the mask head. A background voxel is written
    if its occupancy exceeds ``background_threshold``, as its most probable class. With
    ``class_thresholds`` (paper: without), it is written if its occupancy times the probability of a
    class exceeds the threshold of this class, as the class that exceeds it by the largest factor;
    ``background_threshold`` is then that of an untrained network. An object is written if its score
    exceeds ``score_threshold``, in the voxels where its occupancy exceeds ``foreground_threshold``.
    ``interpolation``: a voxel's occupancy is interpolated "trilinear"-ly between the object's
    cells, or it is that of the cell which holds its centre ("nearest": cells are mapped as boxes).
    The grid has the type of the buffer ``mask_classes``: bytes, unless an export changes it.
    Raises InputError on unknown classes and on values out of range.
    """

    mask_classes: Tensor

    def __init__(
        self,
        mask_classes: Sequence[int],
        background_threshold: float,
        foreground_threshold: float,
        score_threshold: float,
        interpolation: Interpolation = "trilinear",
        class_thresholds: bool = False,
    ) -> None:
        super().__init__()
        check_classes("mask_classes", mask_classes)
        self.classes = list(mask_classes)
        classes = torch.tensor(self.classes, dtype=torch.uint8)
        self.register_buffer("mask_classes", classes, persistent=False)
        self.background_threshold = background_threshold
        self.foreground_threshold = foreground_threshold
        self.score_threshold = score_threshold
        thresholds = ("background_threshold", "foreground_threshold", "score_threshold")
        check_ranges("model.fusion", self, **dict.fromkeys(thresholds, SHARE))
        self.interpolation: Interpolation = interpolation
        self.class_thresholds = None
        if class_thresholds and len(classes):
            self.class_thresholds = ClassThresholds(len(classes), background_threshold)

    def forward(self, output: OccupancyOutput) -> Num[Tensor, "batch x y z"]:
        grid = None
        if output.voxels is not None and output.mask_logits is not None:
            classes = self.background_classes(output.voxels.logits, output.mask_logits)
            grid = write_voxels(output.voxels.coordinates, classes)
        if output.slots is None or output.foreground_logits is None:
            assert grid is not None
            return grid
        slots = output.slots
        if grid is None:
            batch = len(slots.scores)
            grid = self.mask_classes.new_zeros(batch, *GRID_SHAPE)
        return write_objects(
            grid,
            output.foreground_logits,
            slots.boxes3d,
            slots.classes,
            slots.scores > self.score_threshold,
            self.foreground_threshold,
            self.interpolation,
        )

    def background_classes(
        self, occupancy: Float[Tensor, "batch voxel"], masks: Float[Tensor, "batch class voxel"]
    ) -> Num[Tensor, "batch voxel"]:
        """The class of each voxel of the background, of logits of its occupancy and of the classes;
        0 where it is not written."""
        probability = occupancy.float().sigmoid()
        if self.class_thresholds is None:
            best, written = masks.max(1).indices, probability > self.background_threshold
        else:
            masks = masks.float()
            largest, best = (masks - self.class_thresholds().log()[:, None]).max(1)
            written = probability * (largest - masks.logsumexp(1)).exp() > 1
        return torch.where(written, self.mask_classes[best], 0)


def write_voxels(
    coordinates: Int[Tensor, "batch voxel 3"], classes: Num[Tensor, "batch voxel"]
) -> Num[Tensor, "batch x y z"]:
    """Scatter classes into an empty grid; coordinates are distinct voxels of the full grid."""
    _, height, depth = GRID_SHAPE
    flat = (coordinates[..., 0] * height + coordinates[..., 1]) * depth + coordinates[..., 2]
    grid = classes.new_zeros(len(classes), GRID_SHAPE[0] * height * depth)
    return grid.scatter(1, flat, classes).view(-1, *GRID_SHAPE)
