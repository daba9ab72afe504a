"""Boxes in the image and in space, as pure functions.

2D boxes are ``cxcywh`` or ``xyxy``, normalised. 3D boxes are (centre x y z, size x y z) in metres,
aligned with the axes of their frame (grid or camera). The functions take tensors;
``boxes3d_to_camera`` and ``boxes3d_to_grid`` take NumPy arrays too.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from occdetr.geometry.camera import invert_transform, transform_points

EPSILON = 1e-7

_PERMUTATIONS = list(itertools.permutations(range(3)))


def cxcywh_to_xyxy(boxes: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """(centre, size) -> (lower corner, upper corner)."""
    center, half = boxes[..., :2], boxes[..., 2:] / 2
    return torch.cat([center - half, center + half], dim=-1)


def xyxy_to_cxcywh(boxes: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """(lower corner, upper corner) -> (centre, size)."""
    lower, upper = boxes[..., :2], boxes[..., 2:]
    return torch.cat([(lower + upper) / 2, upper - lower], dim=-1)


def _bounds(boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Lower and upper corners of (centre, size) boxes of any dimension."""
    axes = boxes.shape[-1] // 2
    center, half = boxes[..., :axes], boxes[..., axes:] / 2
    return center - half, center + half


def box_iou(a: Float[Tensor, "*#n d"], b: Float[Tensor, "*#n d"]) -> Float[Tensor, " *n"]:
    """IoU of (centre, size) boxes of 2 or 3 axes; ``a[:, None], b[None]`` is pairwise."""
    intersection, union, _ = _overlap(a, b)
    return intersection / (union + EPSILON)


def generalized_box_iou(
    a: Float[Tensor, "*#n d"], b: Float[Tensor, "*#n d"]
) -> Float[Tensor, " *n"]:
    """Generalised IoU (Rezatofighi et al., 2019) of (centre, size) boxes of 2 or 3 axes."""
    intersection, union, hull = _overlap(a, b)
    return intersection / (union + EPSILON) - (hull - union) / (hull + EPSILON)


def _overlap(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    lower_a, upper_a = _bounds(a)
    lower_b, upper_b = _bounds(b)
    inner = torch.minimum(upper_a, upper_b) - torch.maximum(lower_a, lower_b)
    outer = torch.maximum(upper_a, upper_b) - torch.minimum(lower_a, lower_b)
    intersection = inner.clamp(min=0).prod(-1)
    union = (upper_a - lower_a).prod(-1) + (upper_b - lower_b).prod(-1) - intersection
    return intersection, union, outer.prod(-1)


def box3d_corners(boxes: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 8 3"]:
    """The 8 corners of (centre, size) boxes, in any frame."""
    halves = torch.arange(2, dtype=boxes.dtype, device=boxes.device) - 0.5
    signs = torch.cartesian_prod(halves, halves, halves)
    return boxes[..., None, :3] + signs * boxes[..., None, 3:]


def boxes3d_to_camera(boxes: Any, lidar_to_camera: Any) -> Any:
    """Grid-frame boxes [..., box, 6] as boxes along the camera's axes, metres.

    The centre is transformed. The size along each camera axis is that along the grid axis which is
    closest to it, so that the orientation of the camera changes no size: an object that is 4 m long
    in the grid frame is 4 m long in the camera frame. ``lidar_to_camera`` is [..., 4, 4].
    """
    center = transform_points(boxes[..., :3], lidar_to_camera)
    return _join(center, _permute(boxes[..., 3:], _grid_axes(lidar_to_camera)))


def boxes3d_to_grid(boxes: Any, lidar_to_camera: Any) -> Any:
    """The inverse of ``boxes3d_to_camera``: camera-frame boxes [..., box, 6] in the grid frame."""
    inverse = invert_transform if isinstance(lidar_to_camera, Tensor) else np.linalg.inv
    center = transform_points(boxes[..., :3], inverse(lidar_to_camera))
    return _join(center, _permute(boxes[..., 3:], _grid_axes(lidar_to_camera).argsort(-1)))


def _grid_axes(lidar_to_camera: Any) -> Any:
    """The grid axis that lies closest along each camera axis [..., 3], each axis once."""
    stack = torch.stack if isinstance(lidar_to_camera, Tensor) else np.stack
    rotation = abs(lidar_to_camera[..., :3, :3])
    x, y, z = (rotation[..., axis, :] for axis in range(3))
    best = stack([x[..., i] + y[..., j] + z[..., k] for i, j, k in _PERMUTATIONS], -1).argmax(-1)
    axes: Any = [
        sum((best == index) * order[axis] for index, order in enumerate(_PERMUTATIONS))
        for axis in range(3)
    ]
    return stack(axes, -1)


def _permute(sizes: Any, axes: Any) -> Any:
    if isinstance(sizes, Tensor):
        return sizes.gather(-1, axes[..., None, :].expand(sizes.shape))
    return np.take_along_axis(sizes, np.broadcast_to(axes[..., None, :], sizes.shape), axis=-1)


def _join(center: Any, size: Any) -> Any:
    if isinstance(center, Tensor):
        return torch.cat([center, size], dim=-1)
    return np.concatenate([center, size], axis=-1)


def bounds_in_grid(
    boxes: Float[Tensor, "batch box 6"], lidar_to_camera: Any
) -> Float[Tensor, "batch box 6"]:
    """Axis-aligned bounds in the grid frame of the 8 corners of camera-frame boxes.

    ``lidar_to_camera``: a tensor [batch, 4, 4].

    Not the inverse of ``boxes3d_to_camera``: boxes grow with the angle between the frames. With
    KITTI's camera (tilted by 0.4 degrees) a car of 4 m gets 4 cm higher and a truck of 12 m 11 cm;
    with a camera yawed by 30 degrees a car of 4 x 1.8 m becomes 4.4 x 3.6 m.
    """
    transform = invert_transform(lidar_to_camera)
    corners = transform_points(box3d_corners(boxes), transform[:, None])  # B, N, 8, 3
    lower, upper = corners.amin(-2), corners.amax(-2)
    return torch.cat([(lower + upper) / 2, upper - lower], dim=-1)


def enlarge_boxes3d(
    boxes: Float[Tensor, "*n 6"], factor: float, min_size: float
) -> Float[Tensor, "*n 6"]:
    """Scale every size by ``factor`` (paper III-C: 1.5), to at least ``min_size`` metres."""
    return torch.cat([boxes[..., :3], (boxes[..., 3:] * factor).clamp(min=min_size)], dim=-1)
