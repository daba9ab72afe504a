"""Boxes that tile space, their 2 x 2 x 2 children, and their projections (paper III-C).

Children are ordered x, y, z with z fastest: the child index is ``8 * q + 4 * x + 2 * y + z`` for
child (x, y, z) of box q.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from occdetr.geometry.boxes import box3d_corners
from occdetr.geometry.camera import (
    MIN_DEPTH,
    Camera,
    normalize_pixels,
    project_points,
    transform_points,
)
from occdetr.geometry.voxels import GRID_SHAPE, VOXEL_SIZE


def grid_extent() -> list[float]:
    """Length of the grid along x, y and z, metres."""
    return [side * VOXEL_SIZE for side in GRID_SHAPE]


def all_cells(shape: tuple[int, ...]) -> Int[Tensor, "cell 3"]:
    """Integer coordinates of all cells of a grid, z fastest."""
    axes = [torch.arange(side) for side in shape]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def _offsets(device: torch.device) -> Int[Tensor, "8 3"]:
    return all_cells((2, 2, 2)).to(device)


def child_cells(cells: Int[Tensor, "batch cell 3"]) -> Int[Tensor, "batch child 3"]:
    """Coordinates of the 8 children of every cell, counted in the next finer level's cells."""
    return (2 * cells[:, :, None] + _offsets(cells.device)).flatten(1, 2)


def child_boxes(boxes: Float[Tensor, "batch box 6"]) -> Float[Tensor, "batch child 6"]:
    """The 8 octants of every box."""
    center, size = boxes[:, :, None, :3], boxes[:, :, None, 3:]
    shift = (_offsets(boxes.device).to(boxes.dtype) - 0.5) * 0.5
    children = torch.cat([center + shift * size, (size / 2).expand(-1, -1, 8, -1)], dim=-1)
    return children.flatten(1, 2)


def project_centers(
    boxes: Float[Tensor, "batch box 6"], camera: Camera
) -> Float[Tensor, "batch box 2"]:
    """Normalised image positions of the centres of grid-frame boxes, as in ``project_boxes``."""
    return _project(boxes[..., :3], camera)


def project_boxes(
    boxes: Float[Tensor, "batch box 6"], camera: Camera
) -> Float[Tensor, "batch box 4"]:
    """Normalised centres and sizes (cx, cy, w, h) of grid-frame boxes in the image.

    (cx, cy) is the projection of the box's centre, (w, h) the extent of its 8 projected corners,
    clamped to 0.01-1. Centres are clamped to (-1, 2), and those behind the camera are at (-1, -1):
    there deformable attention samples zeros.
    """
    points = torch.cat([boxes[:, :, None, :3], box3d_corners(boxes)], dim=2)  # B, Q, 9, 3
    placed = _project(points.flatten(1, 2), camera)
    placed = placed.unflatten(1, (-1, 9))
    extent = placed[:, :, 1:].amax(2) - placed[:, :, 1:].amin(2)
    return torch.cat([placed[:, :, 0], extent.clamp(0.01, 1.0)], dim=-1)


def _project(points: Tensor, camera: Camera) -> Tensor:
    points = transform_points(points, camera.lidar_to_camera)
    pixels, depth = project_points(points, camera.projection)
    placed = normalize_pixels(pixels, camera.image_size).clamp(-1.0, 2.0)
    return torch.where(depth[..., None] > MIN_DEPTH, placed, torch.full_like(placed, -1.0))
