"""Projections of boxes, also of those that reach behind the camera."""

from __future__ import annotations

import dataclasses

import torch

from model_factory import IMAGE_SIZE, camera
from occdetr.geometry.boxes import box3d_corners
from occdetr.geometry.camera import (
    MIN_DEPTH,
    Camera,
    normalize_pixels,
    project_points,
    transform_points,
)
from occdetr.geometry.subdivision import project_boxes


def wide_camera() -> Camera:
    """It sees much of what is beside it."""
    view = camera(1)
    focal = torch.tensor([0.1, 0.1, 1.0])[:, None] * torch.eye(3, 4) + (1 - torch.eye(3, 4))
    return dataclasses.replace(view, projection=view.projection * focal)


def some_boxes(count: int) -> torch.Tensor:
    """Boxes around the camera, up to 6 m away and up to 8 m long."""
    generator = torch.Generator().manual_seed(0)
    center = 6.0 * (2 * torch.rand(count, 3, generator=generator) - 1)
    return torch.cat([center, 0.2 + 8.0 * torch.rand(count, 3, generator=generator)], dim=-1)


def visible_edges(box: torch.Tensor, view: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions of points all along a box's edges, and which of them are in front of the camera:
    the extreme points of what is visible are among them."""
    corners, share = box3d_corners(box), torch.linspace(0, 1, 2001)[:, None]
    ends = [(i, i | bit) for bit in (4, 2, 1) for i in range(8) if not i & bit]
    points = torch.cat([corners[a].lerp(corners[b], share) for a, b in ends])
    points = transform_points(points[None], view.lidar_to_camera)
    pixels, depth = project_points(points, view.projection)
    return normalize_pixels(pixels, IMAGE_SIZE)[0].clamp(-1, 2), depth[0] > MIN_DEPTH


def test_extents_of_boxes_through_the_camera_plane_are_those_of_their_visible_part() -> None:
    view, boxes, through = wide_camera(), some_boxes(80), 0
    for box, found in zip(boxes, project_boxes(boxes[None], view)[0], strict=True):
        placed, front = visible_edges(box, view)
        if not front.any():
            assert torch.equal(found, torch.tensor([-1.0, -1.0, 0.01, 0.01]))
            continue
        extent = placed[front].amax(0) - placed[front].amin(0)
        assert torch.allclose(found[2:], extent.clamp(0.01, 1.0), atol=0.02)
        through += not front.all()
    assert through > 20


def test_left_and_right_are_alike() -> None:
    """A box behind the plane's left half once had no width, and its mirror image all of it."""
    view, boxes = wide_camera(), some_boxes(200)
    middle = torch.tensor((IMAGE_SIZE[1] - 1) / 2)
    view.projection[:, 0, 2:] = middle * view.projection[:, 2, 2:]
    mirrored = boxes * torch.tensor([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    left, right = (project_boxes(each[None], view)[0] for each in (boxes, mirrored))
    assert torch.allclose(left[:, 1:], right[:, 1:], atol=1e-4)
    seen = (left[:, 0] > -1) & (right[:, 0] > -1)
    assert seen.sum() > 100
    assert torch.allclose(left[seen, 0], 1 - right[seen, 0], atol=1e-4)
