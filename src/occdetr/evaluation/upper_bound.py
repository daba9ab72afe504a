"""The upper bound of a network's design: what it would score if it made no error.

The ground truth is passed through the network's own representation: labels become objects, an
object becomes the cells of its enlarged box, the background the candidates that K leaves at its
resolution; then fusion puts them together. Each limit of the design is measured alone, and all of
them together.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from occdetr.classes import IGNORE, NUM_CLASSES
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.geometry.subdivision import child_cells
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.losses.targets import Resampling, SceneTruth, resample_objects
from occdetr.models.layers import take
from occdetr.models.object_writer import write_objects
from occdetr.models.occdetr import OccupancyDETR
from occdetr.models.occupancy_decoder import OccupancyDecoder
from occdetr.structures import SceneBatch

#: What limits a perfect network of this design, in the order of the table.
LIMITS = {
    "objects": "voxels that no part covers",
    "slots": "objects beyond the slots",
    "object cells": "objects in the cells of their boxes",
    "background cells": "background in cells coarser than a voxel",
    "K": "background cells beyond the K kept",
}


class UpperBound:
    """Scores a network without errors under each limit alone and under all of them.

    ``results``: the figures of ``SemanticSceneCompletion`` by the name of the variant ("none", each
    of ``LIMITS``, "all").
    """

    def __init__(self, model: OccupancyDETR, criterion: OccupancyCriterion) -> None:
        self.model = model
        self.criterion = criterion
        names = tuple(LIMITS)
        self.variants = {"none": (), **{name: (name,) for name in names}, "all": names}
        self.metrics = {name: SemanticSceneCompletion() for name in self.variants}

    @torch.no_grad()
    def update(self, batch: SceneBatch) -> None:
        """Count a batch, which must have labels and targets."""
        truth = SceneTruth.of_batch(batch)
        for index in range(len(truth)):
            frame = truth.frame(index)
            for name, limits in self.variants.items():
                self.metrics[name].update(self.perfect_grid(frame, limits), frame.labels)

    def results(self) -> dict[str, dict]:
        """Figures by variant, as ``SemanticSceneCompletion`` gives them, without the counts."""
        return {
            name: {key: value for key, value in metric.compute().items() if key != "confusion"}
            for name, metric in self.metrics.items()
        }

    def perfect_grid(self, truth: SceneTruth, limits: Iterable[str]) -> UInt8[Tensor, "1 x y z"]:
        """The prediction for one frame of a network whose only errors come from ``limits``."""
        limits, model = set(limits), self.model
        grid = perfect_background(model, self.criterion, truth, limits)
        if model.detector is None:
            return grid
        number = len(truth.targets[0])
        count = min(model.slots.num_slots, number) if "slots" in limits else number
        if "object cells" not in limits:
            inside = (truth.owner > 0) & (truth.owner <= count)
            return torch.where(inside, truth.labels, grid)
        return self._write_objects(grid, truth, count) if count else grid

    def _write_objects(
        self, grid: UInt8[Tensor, "1 x y z"], truth: SceneTruth, count: int
    ) -> UInt8[Tensor, "1 x y z"]:
        """The nearest ``count`` objects through their cells, the nearest on top, as in fusion."""
        model, target = self.model, truth.targets[0]
        boxes, rule = model.slots.enlarge(target.boxes3d_grid), self.criterion.objects.resampling
        cells = [
            perfect_cells(model, truth, one, boxes[one], rule)
            for one in torch.arange(count, device=grid.device).split(1)
        ]
        return write_objects(
            grid,
            torch.cat(cells).logit()[None],
            boxes[None, :count],
            target.classes[None, :count],
            torch.ones(1, count, dtype=torch.bool, device=grid.device),
            model.fusion.foreground_threshold,
            model.fusion.interpolation,
        )


def perfect_background(
    model: OccupancyDETR,
    criterion: OccupancyCriterion,
    truth: SceneTruth,
    limits: Iterable[str],
) -> UInt8[Tensor, "1 x y z"]:
    """The background of one frame, without errors; 0 where there is none.

    Of ``limits``, "objects", "K" and "background cells" matter.
    """
    limits = set(limits)
    background = criterion.background_classes(truth)
    if "objects" not in limits:  # every voxel is some part's
        unanswered = (background == 0) & (truth.owner == 0)
        background = torch.where(unanswered, truth.labels, background)
    grid = background.masked_fill(background == IGNORE, 0)
    decoder = model.occupancy_decoder
    if model.mask_head is not None and "K" in limits:
        grid = grid * kept_voxels(grid > 0, decoder)
    if model.mask_head is not None and "background cells" in limits:
        grid = coarsen(grid, decoder.cell_sizes[-1])
    return grid


def perfect_cells(
    model: OccupancyDETR,
    truth: SceneTruth,
    objects: Int[Tensor, " pair"],
    boxes3d: Float[Tensor, "pair 6"],
    resampling: Resampling = "points",
) -> Float[Tensor, "pair n n n"]:
    """The true output of the occupancy decoder for ``objects`` of one frame, given these boxes: the
    share of each cell that belongs to the object."""
    cells = model.occupancy_decoder.objects.cells
    owner, labels = truth.owner[0], truth.labels[0]
    occupied, _ = resample_objects(owner, labels, objects, boxes3d, cells, resampling)
    return occupied.view(-1, cells, cells, cells)


def kept_voxels(
    occupied: Bool[Tensor, "1 x y z"], decoder: OccupancyDecoder
) -> Bool[Tensor, "1 x y z"]:
    """The voxels inside the cells that remain if each level keeps its K fullest candidates."""
    assert decoder.background is not None
    counts = occupied.float()[:, None]
    coordinates = decoder.cells[None]
    kept = torch.zeros_like(occupied)
    for cell, number in zip(decoder.cell_sizes, decoder.background.kept, strict=False):
        full = F.avg_pool3d(counts, cell)[0, 0]
        candidates = child_cells(coordinates)
        x, y, z = candidates[0].unbind(-1)
        best = full[x, y, z].topk(min(number, candidates.shape[1])).indices
        coordinates = take(candidates, best[None])
        kept = torch.zeros_like(full, dtype=torch.bool)
        kept[tuple(coordinates[0].unbind(-1))] = True
        kept = _repeat(kept, cell)[None]
    return kept


def coarsen(grid: UInt8[Tensor, "1 x y z"], cell: int) -> UInt8[Tensor, "1 x y z"]:
    """Fill every cell that is not empty with the most frequent class in it."""
    if cell == 1:
        return grid
    shares = torch.stack(
        [F.avg_pool3d((grid == index).float(), cell)[0] for index in range(1, NUM_CLASSES)]
    )
    best, index = shares.max(0)
    return _repeat(torch.where(best > 0, index + 1, 0).to(torch.uint8), cell)[None]


def _repeat(cells: Tensor, factor: int) -> Tensor:
    for axis in range(3):
        cells = cells.repeat_interleave(factor, dim=axis)
    return cells
