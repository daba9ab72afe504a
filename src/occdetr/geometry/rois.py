"""Preset regions of interest, one per memory token, and early matching on them (paper III-B)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment


def level_shapes(image_size: tuple[int, int], strides: Sequence[int]) -> list[tuple[int, int]]:
    """(height, width) of each feature level; a stride-2 convolution rounds up."""
    height, width = image_size
    return [(-(-height // stride), -(-width // stride)) for stride in strides]


@dataclass(frozen=True)
class RoiLayout:
    """What determines the preset ROIs: see ``preset_rois``. ``image_size`` is (height, width)."""

    image_size: tuple[int, int]
    strides: Sequence[int]
    scale: float

    def boxes(self) -> Float[NDArray, "token 4"]:
        """The preset ROIs, normalised cxcywh."""
        size = (int(self.image_size[0]), int(self.image_size[1]))
        return preset_rois(size, self.strides, self.scale)


def preset_rois(
    image_size: tuple[int, int], strides: Sequence[int], scale: float
) -> Float[NDArray, "token 4"]:
    """One square box per memory token, centred on it, with a side of ``scale * stride`` pixels.

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
    """Early matching: a distinct preset ROI for each object (Hungarian; L1 and GIoU costs).

    It depends on the labels alone, so that data workers can compute it.
    """
    if len(boxes_cxcywh) == 0:
        return np.zeros(0, dtype=np.int64)
    # one coordinate at a time: NumPy is five times slower over a last axis of length 2 or 4
    l1 = sum(np.abs(a[:, None] - b) for a, b in zip(boxes_cxcywh.T, rois.T, strict=True))
    cost = cost_l1 * l1 - cost_giou * _pairwise_giou(boxes_cxcywh, rois)
    _, columns = linear_sum_assignment(cost)
    return columns.astype(np.int64)


def _pairwise_giou(a: NDArray, b: NDArray) -> NDArray:
    left_a, top_a, right_a, bottom_a = _edges(a)[:, :, None]
    left_b, top_b, right_b, bottom_b = _edges(b)
    inner_x = np.minimum(right_a, right_b) - np.maximum(left_a, left_b)
    inner_y = np.minimum(bottom_a, bottom_b) - np.maximum(top_a, top_b)
    outer_x = np.maximum(right_a, right_b) - np.minimum(left_a, left_b)
    outer_y = np.maximum(bottom_a, bottom_b) - np.minimum(top_a, top_b)
    intersection, hull = inner_x.clip(0) * inner_y.clip(0), outer_x * outer_y
    area_a = (right_a - left_a) * (bottom_a - top_a)
    area_b = (right_b - left_b) * (bottom_b - top_b)
    union = area_a + area_b - intersection
    return intersection / (union + 1e-9) - (hull - union) / (hull + 1e-9)


def _edges(boxes_cxcywh: NDArray) -> NDArray:
    """Left, top, right and bottom [4, box]."""
    center, size = np.split(np.ascontiguousarray(boxes_cxcywh.T), 2)
    return np.concatenate([center - size / 2, center + size / 2])
