"""Ceilings: what a perfect network would score, and which part of the design costs how much.

The ground truth itself goes through what the network's form does to it: labels become objects, an
object the cells of its enlarged box, the background the candidates that K leaves at its resolution;
then fusion puts them together. Each loss is measured alone, and all of them together.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from occdetr.classes import IGNORE, NUM_CLASSES
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.geometry.boxes import enlarge_boxes3d
from occdetr.geometry.subdivision import child_cells
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.losses.targets import object_grid, resample_objects
from occdetr.models.fusion import resample
from occdetr.models.layers import take
from occdetr.models.occdetr import OccupancyDETR
from occdetr.models.occupancy_decoder import OccupancyDecoder
from occdetr.structures import SceneBatch, SceneTarget

#: What the design may lose, in the order of the table.
LOSSES = {
    "objects": "voxels that no part answers for",
    "slots": "objects beyond the slots",
    "object cells": "objects in the cells of their boxes",
    "background cells": "background in cells coarser than a voxel",
    "K": "background cells beyond the K kept",
}


class Oracle:
    """Counts what a perfect network of this form predicts, under each loss alone and all together.

    ``results``: by name of the variant ("none", each of ``LOSSES``, "all") the figures of
    ``SemanticSceneCompletion``.
    """

    def __init__(self, model: OccupancyDETR, criterion: OccupancyCriterion) -> None:
        self.model = model
        self.criterion = criterion
        names = tuple(LOSSES)
        self.variants = {"none": (), **{name: (name,) for name in names}, "all": names}
        self.metrics = {name: SemanticSceneCompletion() for name in self.variants}

    @torch.no_grad()
    def update(self, batch: SceneBatch) -> None:
        """Count a batch, which must have labels and targets."""
        assert batch.labels is not None
        assert batch.targets is not None
        for frame, target in enumerate(batch.targets):
            labels = batch.labels[frame : frame + 1]
            for name, losses in self.variants.items():
                grid = self.perfect_grid(labels, target, losses)
                self.metrics[name].update(grid, labels)

    def results(self) -> dict[str, dict]:
        """Figures by variant, as ``SemanticSceneCompletion`` gives them, without the counts."""
        return {
            name: {key: value for key, value in metric.compute().items() if key != "confusion"}
            for name, metric in self.metrics.items()
        }

    def perfect_grid(
        self, labels: UInt8[Tensor, "1 x y z"], target: SceneTarget, losses: Iterable[str]
    ) -> UInt8[Tensor, "1 x y z"]:
        """One frame's prediction by a network that is right wherever its form lets it be."""
        losses, model = set(losses), self.model
        grid = perfect_background(model, self.criterion, labels, target, losses)
        if model.detector is None:
            return grid
        owner = object_grid(target)
        count = model.num_slots if "slots" in losses else len(target)
        if "object cells" not in losses:
            inside = (owner > 0) & (owner <= count)
            return torch.where(inside[None], labels, grid)
        return self._write_objects(grid, owner, labels[0], target, count)

    def _write_objects(
        self, grid: Tensor, owner: Tensor, labels: Tensor, target: SceneTarget, count: int
    ) -> UInt8[Tensor, "1 x y z"]:
        """The nearest ``count`` objects through their cells, the nearest last, as fusion does."""
        model = self.model
        boxes = enlarge_boxes3d(target.boxes3d_grid, model.enlargement, model.min_box_size)
        for index in reversed(range(min(count, len(target)))):
            one = torch.tensor([index], device=owner.device)
            cells = perfect_cells(model, owner, labels, one, boxes[one])
            inside = resample(cells, boxes[one])
            label = target.classes[index].to(torch.uint8)
            grid = torch.where(inside > model.fusion.foreground_threshold, label, grid)
        return grid


def perfect_background(
    model: OccupancyDETR,
    criterion: OccupancyCriterion,
    labels: UInt8[Tensor, "1 x y z"],
    target: SceneTarget,
    losses: Iterable[str],
) -> UInt8[Tensor, "1 x y z"]:
    """One frame's background, by a network of this form that is right; 0 where it says nothing.

    Of ``losses``, "objects", "K" and "background cells" matter.
    """
    losses = set(losses)
    background = criterion.background_classes(labels, [target])
    if "objects" not in losses:  # somebody answers for every voxel
        unanswered = (background == 0) & (object_grid(target) == 0)[None]
        background = torch.where(unanswered, labels, background)
    grid = background.masked_fill(background == IGNORE, 0)
    decoder = model.occupancy_decoder
    if model.mask_head is not None and "K" in losses:
        grid = grid * kept_voxels(grid > 0, decoder)
    if model.mask_head is not None and "background cells" in losses:
        grid = coarsen(grid, decoder.cell_sizes[-1])
    return grid


def perfect_cells(
    model: OccupancyDETR,
    owner: Int[Tensor, "x y z"],
    labels: UInt8[Tensor, "x y z"],
    objects: Int[Tensor, " pair"],
    boxes3d: Float[Tensor, "pair 6"],
) -> Float[Tensor, "pair n n n"]:
    """What the occupancy decoder should say of ``objects`` in boxes given to them: the share of
    each cell that is theirs. ``owner`` as ``object_grid`` gives it."""
    cells = model.occupancy_decoder.object_cells
    truth, _ = resample_objects(owner, labels, objects, boxes3d, cells)
    return truth.view(-1, cells, cells, cells)


def kept_voxels(
    occupied: Bool[Tensor, "1 x y z"], decoder: OccupancyDecoder
) -> Bool[Tensor, "1 x y z"]:
    """The voxels below the cells that stay if each level keeps its K fullest candidates."""
    counts = occupied.float()[:, None]
    coordinates = decoder.cells[None]
    kept = torch.zeros_like(occupied)
    for cell, number in zip(decoder.cell_sizes, decoder.kept, strict=False):
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
    """Fill every cell that holds something with the class that it holds most of."""
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
