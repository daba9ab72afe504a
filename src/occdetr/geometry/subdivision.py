"""Boxes that tile space, their 2 x 2 x 2 children, and where they are in the image (III-C).

Children are ordered x, y, z with z fastest: child 4 x + 2 y + z of box q stands at 8 q + it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from occdetr.geometry.boxes import box3d_corners
from occdetr.geometry.camera import MIN_DEPTH, normalize_pixels, project_points, transform_points
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
    """Coordinates of the 8 children of every cell, one level finer, in the order of ``Split``."""
    return (2 * cells[:, :, None] + _offsets(cells.device)).flatten(1, 2)


def child_boxes(boxes: Float[Tensor, "batch box 6"]) -> Float[Tensor, "batch child 6"]:
    """The 8 octants of every box, in the order of ``Split``."""
    center, size = boxes[:, :, None, :3], boxes[:, :, None, 3:]
    shift = (_offsets(boxes.device).to(boxes.dtype) - 0.5) * 0.5
    children = torch.cat([center + shift * size, (size / 2).expand(-1, -1, 8, -1)], dim=-1)
    return children.flatten(1, 2)


def project_centers(
    boxes: Float[Tensor, "batch box 6"],
    projection: Float[Tensor, "batch 3 4"],
    lidar_to_camera: Float[Tensor, "batch 4 4"],
    image_size: tuple[int, int],
) -> Float[Tensor, "batch box 2"]:
    """Where the centres of grid-frame boxes are in the image, normalised, as ``project_boxes``."""
    return _project(boxes[..., :3], projection, lidar_to_camera, image_size)


def project_boxes(
    boxes: Float[Tensor, "batch box 6"],
    projection: Float[Tensor, "batch 3 4"],
    lidar_to_camera: Float[Tensor, "batch 4 4"],
    image_size: tuple[int, int],
) -> Float[Tensor, "batch box 4"]:
    """Projections of grid-frame boxes: centre and extent in the image, normalised, bounded.

    The centre is that of the box, the extent that of its 8 projected corners. What lies far outside
    of the image ends just outside of it, where deformable attention samples zeros.
    """
    points = torch.cat([boxes[:, :, None, :3], box3d_corners(boxes)], dim=2)  # B, Q, 9, 3
    placed = _project(points.flatten(1, 2), projection, lidar_to_camera, image_size)
    placed = placed.unflatten(1, (-1, 9))
    extent = placed[:, :, 1:].amax(2) - placed[:, :, 1:].amin(2)
    return torch.cat([placed[:, :, 0], extent.clamp(0.01, 1.0)], dim=-1)


def _project(
    points: Tensor, projection: Tensor, lidar_to_camera: Tensor, image_size: tuple[int, int]
) -> Tensor:
    pixels, depth = project_points(transform_points(points, lidar_to_camera), projection)
    placed = normalize_pixels(pixels, image_size).clamp(-1.0, 2.0)
    return torch.where(depth[..., None] > MIN_DEPTH, placed, torch.full_like(placed, -1.0))
