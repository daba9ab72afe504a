"""Preset regions of interest, one per memory token, and early matching on them (paper III-B)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment


def level_shapes(image_size: tuple[int, int], strides: Sequence[int]) -> list[tuple[int, int]]:
    """(height, width) of each feature level; a stride-2 convolution rounds up."""
    height, width = image_size
    return [(-(-height // stride), -(-width // stride)) for stride in strides]


def preset_rois(
    image_size: tuple[int, int], strides: Sequence[int], scale: float
) -> Float[NDArray, "token 4"]:
    """One box per memory token, centred on it: ``scale`` x stride pixels wide and high.

    Normalised cxcywh, in the order of the flattened memory (levels, rows, columns).
    """
    height, width = image_size
    rois = []
    for stride, (rows, columns) in zip(strides, level_shapes(image_size, strides), strict=True):
        y, x = np.mgrid[0:rows, 0:columns]
        center = np.stack([(x + 0.5) / columns, (y + 0.5) / rows], axis=-1).reshape(-1, 2)
        size = np.array([scale * stride / width, scale * stride / height])
        rois.append(np.concatenate([center, np.broadcast_to(size, center.shape)], axis=1))
    return np.concatenate(rois).astype(np.float32)


def match_rois(
    boxes_cxcywh: Float[NDArray, "object 4"],
    rois: Float[NDArray, "token 4"],
    cost_l1: float = 5.0,
    cost_giou: float = 2.0,
) -> Int[NDArray, " object"]:
    """Early matching: the preset ROI of each object, all distinct (Hungarian; L1 + GIoU).

    It depends on labels alone, so the data workers compute it.
    """
    if len(boxes_cxcywh) == 0:
        return np.zeros(0, dtype=np.int64)
    l1 = np.abs(boxes_cxcywh[:, None] - rois[None]).sum(-1)
    cost = cost_l1 * l1 - cost_giou * _pairwise_giou(boxes_cxcywh, rois)
    _, columns = linear_sum_assignment(cost)
    return columns.astype(np.int64)


def _pairwise_giou(a: NDArray, b: NDArray) -> NDArray:
    lower_a, upper_a = a[:, None, :2] - a[:, None, 2:] / 2, a[:, None, :2] + a[:, None, 2:] / 2
    lower_b, upper_b = b[None, :, :2] - b[None, :, 2:] / 2, b[None, :, :2] + b[None, :, 2:] / 2
    inner = np.minimum(upper_a, upper_b) - np.maximum(lower_a, lower_b)
    outer = np.maximum(upper_a, upper_b) - np.minimum(lower_a, lower_b)
    intersection = inner.clip(0).prod(-1)
    area_a, area_b = (upper_a - lower_a).prod(-1), (upper_b - lower_b).prod(-1)
    union = area_a + area_b - intersection
    hull = outer.prod(-1)
    return intersection / (union + 1e-9) - (hull - union) / (hull + 1e-9)
