"""Objects written over a semantic grid: one operator with two forms that give equal classes.

On the CPU a compiled kernel visits only the voxels inside the boxes of objects in use. Elsewhere,
and in an exported graph, PyTorch's form has static shapes: one reduction over all slots.
"""

from __future__ import annotations

from typing import Literal, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Num
from torch import Tensor

from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE

Interpolation = Literal["trilinear", "nearest"]

#: Of all grids of a batch, that PyTorch's form has in memory at once: 8 MiB a slot in float32 at
#: batch 1, and no more in a larger batch.
PLANES = 64


def write_objects(
    grid: Num[Tensor, "batch x y z"],
    logits: Float[Tensor, "batch slot n n n"],
    boxes3d: Float[Tensor, "batch slot 6"],
    classes: Int[Tensor, "batch slot"],
    written: Bool[Tensor, "batch slot"],
    threshold: float,
    interpolation: Interpolation = "trilinear",
) -> Num[Tensor, "batch x y z"]:
    """A new grid with the class of every ``written`` object in its voxels; the first one is on top.

    ``logits``: the occupancy of each object in the cells of its box (metres, centre and size).
    A voxel is the object's if its centre is inside the box and its occupancy, interpolated between
    the cells, exceeds ``threshold``.
    """
    own_form = grid.device.type == "cpu" and not torch.compiler.is_exporting()
    write = _write_on_cpu if own_form else write_at_all_voxels
    places = [_places(boxes3d, axis, logits.shape[-1], interpolation) for axis in range(3)]
    lower, weights = map(list, zip(*places, strict=True))
    return write(grid, logits.detach(), lower, weights, classes.to(grid.dtype), written, threshold)


def _places(
    boxes3d: Float[Tensor, "batch slot 6"], axis: int, side: int, interpolation: Interpolation
) -> tuple[Int[Tensor, "batch slot voxel"], Float[Tensor, "batch slot voxel 2"]]:
    """Of ``side`` cells along an axis, the lower one of the two that the centre of each voxel is
    between, and the weights of both: 0 outside of the box.

    Beyond the centre of the outermost cell its value holds to the face of the box.
    """
    index = torch.arange(GRID_SHAPE[axis], device=boxes3d.device, dtype=boxes3d.dtype)
    center = GRID_ORIGIN[axis] + (index + 0.5) * VOXEL_SIZE
    size = boxes3d[..., 3 + axis, None].clamp(min=1e-3)
    place = (center - boxes3d[..., axis, None]) / size + 0.5
    inside = (place >= 0) & (place <= 1)
    if interpolation == "nearest":
        lower = (place * side).floor().clamp(0, side - 1)
        shares = torch.stack([torch.ones_like(lower), torch.zeros_like(lower)], dim=-1)
    else:
        position = (place * side - 0.5).clamp(0, side - 1)
        lower = position.floor()
        shares = torch.stack([1 - (position - lower), 1 - (lower + 1 - position)], dim=-1)
    return lower.nan_to_num(0.0).to(torch.int32), torch.where(inside[..., None], shares, 0.0)


def axis_weights(
    box3d: Float[Tensor, " 6"], axis: int, side: int, interpolation: Interpolation
) -> Float[Tensor, "voxel {side}"]:
    """The weights of the ``side`` cells of a box at the voxels along an axis, as a matrix."""
    lower, shares = (each[0, 0] for each in _places(box3d[None, None], axis, side, interpolation))
    upper = (lower + 1).clamp(max=side - 1)
    weights = shares.new_zeros(len(lower), side)
    for cell, share in ((lower, shares[:, 0]), (upper, shares[:, 1])):
        weights.scatter_add_(1, cell[:, None].long(), share[:, None])
    return weights


def write_at_all_voxels(
    grid: Num[Tensor, "batch x y z"],
    logits: Float[Tensor, "batch slot n n n"],
    lower: list[Int[Tensor, "batch slot _"]],
    weights: list[Float[Tensor, "batch slot _ 2"]],
    classes: Num[Tensor, "batch slot"],
    written: Bool[Tensor, "batch slot"],
    threshold: float,
) -> Num[Tensor, "batch x y z"]:
    """PyTorch's form: every slot at every voxel, in static shapes and without synchronisation.

    A compiler makes one kernel of the interpolation along x and the maximum over the slots. Without
    it, about four tensors of ``PLANES`` planes of every slot are in memory: 2 GiB at 64 slots.
    """
    slots = written.shape[1]
    values = (logits.float().sigmoid() * written[..., None, None, None]).flatten(0, 1)
    places = zip(lower, weights, strict=True)
    steps = [(cell.flatten(0, 1).long(), weight.flatten(0, 1)) for cell, weight in places]
    values = _interpolate(values.permute(0, 3, 1, 2), *steps[2])  # slot, z, cell, cell
    values = _interpolate(values.permute(0, 3, 1, 2), *steps[1])  # slot, y, z, cell
    values = values.permute(0, 3, 1, 2).contiguous()  # slot, cell, y, z
    order = torch.arange(slots, 0, -1, device=grid.device, dtype=torch.int32)  # the first is on top
    names = torch.cat([torch.zeros_like(classes[:, :1]), classes.flip(1)], dim=1)
    planes, thickness = [], max(PLANES // max(len(grid), 1), 1)
    for start in range(0, GRID_SHAPE[0], thickness):
        part = [step[:, start : start + thickness] for step in steps[0]]
        inside = _interpolate(values, *part) > threshold
        inside = inside.unflatten(0, (-1, slots))
        top = torch.where(inside, order[:, None, None, None], 0).amax(1)
        name = names.gather(1, top.flatten(1).long()).view(top.shape)
        planes.append(torch.where(top > 0, name, grid[:, start : start + thickness]))
    return torch.cat(planes, dim=1)


def _interpolate(
    values: Float[Tensor, "slot cell a b"],
    lower: Int[Tensor, "slot voxel"],
    weights: Float[Tensor, "slot voxel 2"],
) -> Float[Tensor, "slot voxel a b"]:
    """Linear interpolation between the cells of the second axis."""
    slot = torch.arange(len(values), device=values.device)[:, None]
    upper = (lower + 1).clamp(max=values.shape[1] - 1)
    low, high = weights[..., None, None].unbind(2)
    return values[slot, lower] * low + values[slot, upper] * high


_SCHEMA = (
    "(Tensor grid, Tensor logits, Tensor[] lower, Tensor[] weights, Tensor classes, "
    "Tensor written, float threshold) -> Tensor"
)


@torch.library.custom_op(
    "occdetr::write_objects", mutates_args=(), device_types="cpu", schema=_SCHEMA
)
def _write_on_cpu(
    grid: Tensor,
    logits: Tensor,
    lower: list[Tensor],
    weights: list[Tensor],
    classes: Tensor,
    written: Tensor,
    threshold: float,
) -> Tensor:
    """The kernel's form; arguments and result as those of ``write_at_all_voxels``."""
    grid = grid.clone(memory_format=torch.contiguous_format)
    for frame, kept in enumerate(written):
        occupancy = logits[frame][kept].float().sigmoid().numpy()
        cells, shares = (tuple(x[frame][kept].numpy() for x in axes) for axes in (lower, weights))
        names = classes[frame][kept].numpy()
        _write_frame(grid[frame].numpy(), occupancy, cells, shares, names, np.float32(threshold))
    return grid


@_write_on_cpu.register_fake
def _(grid: Tensor, *_: object) -> Tensor:
    return torch.empty_like(grid, memory_format=torch.contiguous_format)


@no_type_check
@numba.njit(cache=True, nogil=True)
def _write_frame(grid, occupancy, cells, weights, classes, threshold):  # pragma: no cover
    """Interpolate along z, then y, then x, each between its first and last voxel in the box."""
    side, (_, height, depth) = occupancy.shape[1], grid.shape
    along_z = np.empty((side, side, depth), np.float32)
    along_y = np.empty((side, height, depth), np.float32)
    for slot in range(len(classes) - 1, -1, -1):  # the first is on top
        start, end = _bounds(weights[2][slot])
        for i in range(side):
            for j in range(side):
                for z in range(start, end):
                    cell, share = cells[2][slot, z], weights[2][slot, z]
                    upper = min(cell + 1, side - 1)
                    low, high = occupancy[slot, i, j, cell], occupancy[slot, i, j, upper]
                    along_z[i, j, z] = low * share[0] + high * share[1]
        first, last = _bounds(weights[1][slot])
        for i in range(side):
            for y in range(first, last):
                cell, share = cells[1][slot, y], weights[1][slot, y]
                low, high = along_z[i, cell], along_z[i, min(cell + 1, side - 1)]
                for z in range(start, end):
                    along_y[i, y, z] = low[z] * share[0] + high[z] * share[1]
        for x in range(*_bounds(weights[0][slot])):
            cell, share = cells[0][slot, x], weights[0][slot, x]
            for y in range(first, last):
                low, high = along_y[cell, y], along_y[min(cell + 1, side - 1), y]
                row = grid[x, y]
                for z in range(start, end):
                    inside = low[z] * share[0] + high[z] * share[1] > threshold
                    row[z] = classes[slot] if inside else row[z]


@no_type_check
@numba.njit(cache=True, nogil=True)
def _bounds(weights):  # pragma: no cover
    """The first voxel with a weight, and the one after the last: they are a box's."""
    inside = np.nonzero(weights[:, 0] > 0)[0]
    return (inside[0], inside[-1] + 1) if len(inside) else (0, 0)
