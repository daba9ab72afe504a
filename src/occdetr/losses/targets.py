"""The truth of objects in the cells of boxes: what the foreground's occupancy is held against."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from occdetr.classes import IGNORE
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.structures import SceneTarget

SUPERSAMPLE = 2  # points per side of an object cell whose mean is the cell's true occupancy


def object_grid(target: SceneTarget) -> Int[Tensor, "x y z"]:
    """For every voxel 1 + the object it belongs to, 0 where it belongs to none."""
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
) -> tuple[Float[Tensor, "pair cell"], Float[Tensor, "pair cell"]]:
    """Occupied and known shares of the cells of each box, for the object that belongs to it.

    The paper scales the local ground truth by linear interpolation; here the mean of
    ``SUPERSAMPLE``^3 points of each cell, so that thin parts are not lost between the points.
    """
    side = cells * SUPERSAMPLE
    steps = (torch.arange(side, device=boxes3d.device) + 0.5) / side - 0.5
    origin = boxes3d.new_tensor(GRID_ORIGIN)
    points = boxes3d[:, :3, None] + boxes3d[:, 3:, None] * steps  # M, 3, side
    index = ((points - origin[:, None]) / VOXEL_SIZE).floor().long()
    shape = torch.tensor(GRID_SHAPE, device=index.device)[:, None]
    inside = (index >= 0) & (index < shape)
    index = index.clamp(min=0).minimum(shape - 1)
    x, y, z = index[:, 0, :, None, None], index[:, 1, None, :, None], index[:, 2, None, None, :]
    valid = inside[:, 0, :, None, None] & inside[:, 1, None, :, None] & inside[:, 2, None, None, :]
    flat = (x * GRID_SHAPE[1] + y) * GRID_SHAPE[2] + z
    mine = (owner.view(-1)[flat] == objects[:, None, None, None] + 1) & valid
    known = (labels.view(-1)[flat] != IGNORE) & valid
    return _cell_means(mine, cells), _cell_means(known, cells)


def _cell_means(points: Bool[Tensor, "pair x y z"], cells: int) -> Float[Tensor, "pair cell"]:
    means = F.avg_pool3d(points.float()[:, None], SUPERSAMPLE)
    return means.reshape(len(points), cells**3)
