"""Boxes that tile space, their 2 x 2 x 2 children, and their projections (paper III-C).

Children are ordered x, y, z with z fastest: the child index is ``8 * q + 4 * x + 2 * y + z`` for
child (x, y, z) of box q.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from occdetr.geometry.camera import MIN_DEPTH, Camera
from occdetr.geometry.voxels import GRID_SHAPE, VOXEL_SIZE


def grid_extent() -> list[float]:
    """Length of the grid along x, y and z, metres."""
    return [side * VOXEL_SIZE for side in GRID_SHAPE]


def all_cells(shape: tuple[int, ...], device: torch.device | None = None) -> Int[Tensor, "cell 3"]:
    """Integer coordinates of all cells of a grid, z fastest; made on ``device``."""
    axes = [torch.arange(side, device=device) for side in shape]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def child_cells(cells: Int[Tensor, "batch cell 3"]) -> Int[Tensor, "batch child 3"]:
    """Coordinates of the 8 children of every cell, counted in the next finer level's cells."""
    return (2 * cells[:, :, None] + all_cells((2, 2, 2), cells.device)).flatten(1, 2)


def child_boxes(boxes: Float[Tensor, "batch box 6"]) -> Float[Tensor, "batch child 6"]:
    """The 8 octants of every box."""
    center, size = boxes[:, :, None, :3], boxes[:, :, None, 3:]
    shift = (all_cells((2, 2, 2), boxes.device).to(boxes.dtype) - 0.5) * 0.5
    children = torch.cat([center + shift * size, (size / 2).expand(-1, -1, 8, -1)], dim=-1)
    return children.flatten(1, 2)


def project_centers(
    boxes: Float[Tensor, "batch box 6"], camera: Camera
) -> Float[Tensor, "batch box 2"]:
    """Normalised image positions of the centres of grid-frame boxes, as in ``project_boxes``."""
    matrix = _pixel_matrix(camera)[..., None]
    center = boxes[..., :3].transpose(1, 2)
    center = (matrix[:, :, :3] * center[:, None]).sum(2) + matrix[:, :, 3]
    return torch.where(center[:, 2:] > MIN_DEPTH, _place(center, camera), -1.0).transpose(1, 2)


def project_boxes(
    boxes: Float[Tensor, "batch box 6"], camera: Camera
) -> Float[Tensor, "batch box 4"]:
    """Normalised centres and sizes (cx, cy, w, h) of grid-frame boxes in the image.

    (cx, cy) is the projection of the box's centre, (w, h) the extent of that part of the box which
    is in front of the camera (``MIN_DEPTH``), clamped to 0.01-1. Positions are clamped to (-1, 2).
    If its centre is behind the camera, (cx, cy) is the middle of the extent; boxes all behind it
    are at (-1, -1): there deformable attention samples zeros.
    """
    matrix = _pixel_matrix(camera)[..., None]  # boxes come last here: reductions over rows are fast
    center, size = boxes.transpose(1, 2).split(3, dim=1)
    center = (matrix[:, :, :3] * center[:, None]).sum(2) + matrix[:, :, 3]  # B, 3, Q
    half = matrix[:, :, :3] * (size[:, None] / 2)  # B, 3, axis, Q
    corners = center[:, :, None, None, None]
    for axis in range(3):
        shape = [1, 1, 1]
        shape[axis] = 2
        steps = torch.stack([-half[:, :, axis], half[:, :, axis]], dim=2)
        corners = corners + steps.unflatten(2, shape)
    cuts, cut = zip(*[_cut_edges(corners, 2 * half, axis) for axis in range(3)], strict=True)
    corners = corners.flatten(2, 4)
    bounds = torch.cat([_place(corners, camera), *[_place(each, camera) for each in cuts]], dim=2)
    visible = torch.cat([corners[:, 2] > MIN_DEPTH, *cut], dim=1)[:, None]
    lower = bounds.masked_fill(~visible, 2.0).amin(2)
    upper = bounds.masked_fill(~visible, -1.0).amax(2)
    middle = torch.where(visible.any(2), (lower + upper) / 2, -1.0)
    middle = torch.where(center[:, 2:] > MIN_DEPTH, _place(center, camera), middle)
    return torch.cat([middle, (upper - lower).clamp(0.01, 1.0)], dim=1).transpose(1, 2)


def _pixel_matrix(camera: Camera) -> Float[Tensor, "batch 3 4"]:
    """From grid-frame points to (u, v, 1) times their depth; without a matrix product, which
    autocast would compute in bf16."""
    return (camera.projection[:, :, :, None] * camera.lidar_to_camera[:, None]).sum(2)


def _cut_edges(
    corners: Float[Tensor, "batch 3 2 2 2 box"], edges: Float[Tensor, "batch 3 3 box"], axis: int
) -> tuple[Float[Tensor, "batch 3 4 box"], Bool[Tensor, "batch 4 box"]]:
    """Where the edges of boxes along an axis meet the plane ``MIN_DEPTH`` in front of the camera,
    and which do. ``corners`` and ``edges`` are pixels times depth, and depth."""
    start = corners.select(2 + axis, 0).flatten(2, 3)
    edge = edges[:, :, axis, None]
    depth, step = start[:, 2], edge[:, 2]
    cut = (depth > MIN_DEPTH) != (depth + step > MIN_DEPTH)
    share = torch.where(cut, (MIN_DEPTH - depth) / torch.where(cut, step, 1.0), 0.0)
    return start + share[:, None] * edge, cut


def _place(points: Float[Tensor, "batch 3 *n"], camera: Camera) -> Float[Tensor, "batch 2 *n"]:
    """Normalised positions, clamped to (-1, 2), of pixels times depth, and depth."""
    height, width = camera.image_size
    depth = points[:, 2].clamp(min=MIN_DEPTH)
    u, v = points[:, 0] / depth, points[:, 1] / depth
    return torch.stack([(u + 0.5) / width, (v + 0.5) / height], dim=1).clamp(-1.0, 2.0)
