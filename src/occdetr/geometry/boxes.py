"""Boxes in the image and in space, as pure functions on tensors.

2D: ``cxcywh`` and ``xyxy``, normalised. 3D: (centre x y z, size x y z) in metres, aligned with the
axes of the frame they are in.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from occdetr.geometry.camera import transform_points

EPSILON = 1e-7


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
    """The 8 corners of (centre, size) boxes."""
    signs = torch.tensor(
        [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)],
        dtype=boxes.dtype,
        device=boxes.device,
    )
    return boxes[..., None, :3] + signs * boxes[..., None, 3:]


def transform_boxes3d(
    boxes: Float[Tensor, "batch n 6"], transform: Float[Tensor, "batch 4 4"]
) -> Float[Tensor, "batch n 6"]:
    """Bring boxes into another frame: transform the 8 corners, take the axis-aligned bounds."""
    corners = transform_points(box3d_corners(boxes), transform[:, None])  # B, N, 8, 3
    lower, upper = corners.amin(-2), corners.amax(-2)
    return torch.cat([(lower + upper) / 2, upper - lower], dim=-1)


def enlarge_boxes3d(
    boxes: Float[Tensor, "*n 6"], factor: float, min_size: float
) -> Float[Tensor, "*n 6"]:
    """Scale every size by ``factor`` (paper III-C: 1.5), to at least ``min_size`` metres."""
    return torch.cat([boxes[..., :3], (boxes[..., 3:] * factor).clamp(min=min_size)], dim=-1)
