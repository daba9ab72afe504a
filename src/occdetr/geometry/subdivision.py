"""Boxes that tile space, their 2 x 2 x 2 children, and their projections (paper III-C).

Children are ordered x, y, z with z fastest: the child index is ``8 * q + 4 * x + 2 * y + z`` for
child (x, y, z) of box q.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
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
    return _project(boxes[..., :3], camera)


def project_boxes(
    boxes: Float[Tensor, "batch box 6"], camera: Camera
) -> Float[Tensor, "batch box 4"]:
    """Normalised centres and sizes (cx, cy, w, h) of grid-frame boxes in the image.

    (cx, cy) is the projection of the box's centre, (w, h) the extent of that part of the box which
    is in front of the camera (``MIN_DEPTH``), clamped to 0.01-1. Positions are clamped to (-1, 2).
    If its centre is behind the camera, (cx, cy) is the middle of the extent; boxes all behind it
    are at (-1, -1): there deformable attention samples zeros.
    """
    points = torch.cat([boxes[:, :, None, :3], box3d_corners(boxes)], dim=2)  # B, Q, 9, 3
    points = transform_points(points.flatten(1, 2), camera.lidar_to_camera)
    placed, front, depth = _place(points, camera)
    center, corners = placed.unflatten(1, (-1, 9)).split((1, 8), dim=2)
    center_in_front, corners_in_front = front.unflatten(1, (-1, 9)).split((1, 8), dim=2)
    cuts, cut = _cut_edges(points.unflatten(1, (-1, 9)), depth.unflatten(1, (-1, 9)), camera)
    visible = torch.cat([corners_in_front, cut], dim=2)[..., None]
    bounds = torch.cat([corners, cuts], dim=2)  # B, Q, 8 + 12, 2
    lower = bounds.masked_fill(~visible, 2.0).amin(2)
    upper = bounds.masked_fill(~visible, -1.0).amax(2)
    anything = visible.any(2)
    middle = torch.where(anything, (lower + upper) / 2, -1.0)
    middle = torch.where(center_in_front, center[:, :, 0], middle)
    return torch.cat([middle, (upper - lower).clamp(0.01, 1.0)], dim=-1)


def _cut_edges(
    points: Float[Tensor, "batch box 9 3"], depth: Float[Tensor, "batch box 9"], camera: Camera
) -> tuple[Float[Tensor, "batch box 12 2"], Bool[Tensor, "batch box 12"]]:
    """Where the edges of boxes meet the plane ``MIN_DEPTH`` in front of the camera, and which do.

    ``points`` are the centre and the corners in the camera frame.
    """
    near, far = _edges(points[:, :, 1:])
    start, end = (ends[..., 0] for ends in _edges(depth[:, :, 1:, None]))
    cut = (start > MIN_DEPTH) != (end > MIN_DEPTH)
    share = torch.where(cut, (MIN_DEPTH - start) / torch.where(cut, end - start, 1.0), 0.0)
    meeting = near.lerp(far, share[..., None])
    placed, _, _ = _place(meeting.flatten(1, 2), camera)
    return placed.unflatten(1, (-1, 12)), cut


def _edges(
    corners: Float[Tensor, "batch box 8 n"],
) -> tuple[Float[Tensor, "batch box 12 n"], Float[Tensor, "batch box 12 n"]]:
    """The values at both ends of the 12 edges of boxes, from those at the corners."""
    cube = corners.unflatten(2, (2, 2, 2))
    ends = [[end.flatten(2, 3) for end in cube.unbind(axis)] for axis in (2, 3, 4)]
    first, second = (torch.cat(part, dim=2) for part in zip(*ends, strict=True))
    return first, second


def _project(points: Tensor, camera: Camera) -> Tensor:
    placed, front, _ = _place(transform_points(points, camera.lidar_to_camera), camera)
    return torch.where(front[..., None], placed, torch.full_like(placed, -1.0))


def _place(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Normalised positions of camera-frame points, clamped to (-1, 2), which of the points are in
    front of the camera, and their depths."""
    pixels, depth = project_points(points, camera.projection)
    placed = normalize_pixels(pixels, camera.image_size).clamp(-1.0, 2.0)
    return placed, depth > MIN_DEPTH, depth
