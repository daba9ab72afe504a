"""The truth of a batch on dense grids, and of objects in the cells of boxes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Self

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from occdetr.classes import IGNORE
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.structures import SceneBatch, SceneTarget

Resampling = Literal["points", "linear"]

SUPERSAMPLE = 2  # points per side of an object cell whose mean is the cell's true occupancy


@dataclass(frozen=True)
class ObjectTruth:
    """How the truth of the objects' cells is made.

    ``resampling``: see ``resample_objects`` (paper: "linear"). ``missed_boxes``: matched boxes
    without any true cell "skip" the foreground terms, or they "count" (paper), where dice rewards
    an empty prediction.
    """

    resampling: Resampling = "points"
    missed_boxes: Literal["skip", "count"] = "skip"


@dataclass(frozen=True)
class SceneTruth:
    """Labels and objects of a batch; made once per batch, as ``owner`` is a dense grid.

    ``owner`` is 1 + the index of the object that a voxel belongs to, 0 where it belongs to none.
    """

    labels: UInt8[Tensor, "batch x y z"]
    targets: list[SceneTarget]
    owner: Int[Tensor, "batch x y z"]

    @classmethod
    def of_batch(cls, batch: SceneBatch) -> Self:
        """The truth of a batch, which must have labels and targets."""
        assert batch.labels is not None
        assert batch.targets is not None
        return cls.of(batch.labels, batch.targets)

    @classmethod
    def of(cls, labels: UInt8[Tensor, "batch x y z"], targets: Sequence[SceneTarget]) -> Self:
        owner = torch.stack([object_grid(target) for target in targets])
        return cls(labels, list(targets), owner)

    def frame(self, index: int) -> Self:
        """One frame, still as a batch."""
        one = slice(index, index + 1)
        return type(self)(self.labels[one], self.targets[one], self.owner[one])

    def __len__(self) -> int:
        return len(self.labels)


def object_grid(target: SceneTarget) -> Int[Tensor, "x y z"]:
    """For every voxel 1 + the object that it belongs to, 0 where it belongs to none."""
    grid = torch.zeros(GRID_SHAPE, dtype=torch.int16, device=target.classes.device)
    x, y, z = target.voxels.long().unbind(1)
    grid[x, y, z] = (target.voxel_object + 1).to(torch.int16)
    return grid


def resample_objects(
    owner: Int[Tensor, "x y z"],
    labels: UInt8[Tensor, "x y z"],
    objects: Int[Tensor, " pair"],
    boxes3d: Float[Tensor, "pair 6"],
    cells: int,
    method: Resampling = "points",
) -> tuple[Float[Tensor, "pair cell"], Float[Tensor, "pair cell"]]:
    """Occupied and known shares of the cells of each box, for the object that belongs to it.

    ``method``: "points" is the mean of ``SUPERSAMPLE``^3 points of each cell, so that thin parts
    between the cells' centres are not lost; "linear" interpolates between the voxels around the
    cell's centre, as the paper scales the local ground truth.
    """
    side = cells * SUPERSAMPLE if method == "points" else cells
    steps = (torch.arange(side, device=boxes3d.device) + 0.5) / side - 0.5
    points = boxes3d[:, :3, None] + boxes3d[:, 3:, None] * steps  # M, 3, side
    axes = zip(points.unbind(1), GRID_ORIGIN, strict=True)
    places = torch.stack([axis - origin for axis, origin in axes], dim=1) / VOXEL_SIZE  # in voxels
    if method == "points":
        index = places.floor().long()
        mine = _cell_means(owner, index, lambda rows: rows == objects[:, None, None, None] + 1)
        return mine, _cell_means(labels, index, lambda rows: rows != IGNORE)
    return _interpolate(owner, labels, objects, places - 0.5)


def _look_up(
    owner: Int[Tensor, "x y z"],
    labels: UInt8[Tensor, "x y z"],
    objects: Int[Tensor, " pair"],
    index: tuple[Int[Tensor, "pair side"], ...],
) -> tuple[Bool[Tensor, "pair side side side"], Bool[Tensor, "pair side side side"]]:
    """Whether the voxels at ``index`` (by axis) are the object's, and known; outside neither."""
    (x, y, z), (in_x, in_y, in_z) = _in_grid(index)
    valid = in_x[:, :, None, None] & in_y[:, None, :, None] & in_z[:, None, None, :]
    rows = x[:, :, None, None] * GRID_SHAPE[1] + y[:, None, :, None]
    flat = rows * GRID_SHAPE[2] + z[:, None, None, :]
    mine = (owner.view(-1)[flat] == objects[:, None, None, None] + 1) & valid
    known = (labels.view(-1)[flat] != IGNORE) & valid
    return mine, known


def _interpolate(
    owner: Int[Tensor, "x y z"],
    labels: UInt8[Tensor, "x y z"],
    objects: Int[Tensor, " pair"],
    places: Float[Tensor, "pair 3 side"],
) -> tuple[Float[Tensor, "pair cell"], Float[Tensor, "pair cell"]]:
    """Trilinear interpolation; ``places`` count voxels per axis, 0 at the first one's centre."""
    lower = places.floor()
    shares = (1 - (places - lower)).unbind(1), (places - lower).unbind(1)
    index = lower.long().unbind(1), (lower.long() + 1).unbind(1)
    side = places.shape[-1]
    mine = places.new_zeros(len(places), side, side, side)
    known = torch.zeros_like(mine)
    for corner in itertools.product((0, 1), repeat=3):
        x, y, z = (shares[end][axis] for axis, end in enumerate(corner))
        weight = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
        voxels = tuple(index[end][axis] for axis, end in enumerate(corner))
        of_object, of_known = _look_up(owner, labels, objects, voxels)
        mine, known = mine + weight * of_object, known + weight * of_known
    return mine.flatten(1), known.flatten(1)


def _cell_means(
    grid: Shaped[Tensor, "x y z"],
    index: Int[Tensor, "pair 3 side"],
    select: Callable[[Shaped[Tensor, "pair side side z"]], Bool[Tensor, "pair side side z"]],
) -> Float[Tensor, "pair cell"]:
    """The share of the points of each cell whose voxel is inside the grid and selected.

    ``index`` are the points' voxels by axis. Along z whole columns of voxels are looked up, and
    summed over x and y, before the points take their voxels.
    """
    (x, y, z), (in_x, in_y, in_z) = _in_grid(index.unbind(1))
    columns = select(grid[x[:, :, None], y[:, None, :]])
    columns = columns & (in_x[:, :, None] & in_y[:, None, :])[..., None]
    counts = _by_cell(_by_cell(columns.to(torch.uint8), axis=1), axis=2)
    points = counts.gather(3, z[:, None, None].expand(*counts.shape[:3], -1))
    counts = _by_cell(points * in_z[:, None, None], axis=3)
    return counts.flatten(1).float() / SUPERSAMPLE**3


def _by_cell(counts: UInt8[Tensor, "*n"], axis: int) -> UInt8[Tensor, "*m"]:
    """The sums of the ``SUPERSAMPLE`` points of each cell along an axis."""
    first, *others = counts.unflatten(axis, (-1, SUPERSAMPLE)).unbind(axis + 1)
    return sum(others, first)


def _in_grid(
    index: tuple[Int[Tensor, "pair side"], ...],
) -> tuple[list[Int[Tensor, "pair side"]], list[Bool[Tensor, "pair side"]]]:
    """By axis: the voxels, those outside of the grid moved to its border; and which are inside."""
    axes = list(zip(index, GRID_SHAPE, strict=True))
    moved = [voxel.clamp(0, side - 1) for voxel, side in axes]
    return moved, [(voxel >= 0) & (voxel < side) for voxel, side in axes]
