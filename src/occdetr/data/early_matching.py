"""Early matching of objects to preset ROIs (paper, Section III-B).

It depends on the labels alone, not on the network's output, so the data workers compute it.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, Int
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment


def match_rois(
    boxes_cxcywh: Float[NDArray, "object 4"],
    rois: Float[NDArray, "token 4"],
    cost_l1: float = 5.0,
    cost_giou: float = 2.0,
) -> Int[NDArray, " object"]:
    """The index of the preset ROI of each object, all distinct (Hungarian algorithm).

    If there are more objects than ROIs, those that have none get -1.

    The cost of a pair is ``cost_l1`` times the L1 distance of the boxes (normalised cxcywh) minus
    ``cost_giou`` times their generalised IoU.
    """
    if len(boxes_cxcywh) == 0:
        return np.zeros(0, dtype=np.int64)
    cost = np.empty((len(boxes_cxcywh), len(rois)), np.float32)
    _fill_costs(_boxes(boxes_cxcywh), _boxes(rois), cost_l1, cost_giou, cost)
    rows, columns = linear_sum_assignment(cost)
    matched = np.full(len(boxes_cxcywh), -1, dtype=np.int64)
    matched[rows] = columns
    return matched


def _boxes(boxes_cxcywh: Float[NDArray, "box 4"]) -> Float32[NDArray, "4 box"]:
    return np.ascontiguousarray(boxes_cxcywh.T, dtype=np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
@no_type_check  # numba cannot compile what jaxtyping's import hook wraps
def _fill_costs(a, b, cost_l1, cost_giou, cost):
    """One pass over all pairs: NumPy writes thirty arrays of their number."""
    l1, gain, small = np.float32(cost_l1), np.float32(cost_giou), np.float32(1e-9)
    half, nothing = np.float32(0.5), np.float32(0)
    for i in range(a.shape[1]):
        x, y, w, h = a[0, i], a[1, i], a[2, i], a[3, i]
        for j in range(b.shape[1]):
            distance_x, distance_y = abs(x - b[0, j]), abs(y - b[1, j])
            sum_w, sum_h = half * (w + b[2, j]), half * (h + b[3, j])
            change_w, change_h = abs(w - b[2, j]), abs(h - b[3, j])
            hull_w = max(sum_w + distance_x, w, b[2, j])
            hull_h = max(sum_h + distance_y, h, b[3, j])
            inner_w = max(min(sum_w - distance_x, w, b[2, j]), nothing)
            inner_h = max(min(sum_h - distance_y, h, b[3, j]), nothing)
            shared, hull = inner_w * inner_h, hull_w * hull_h
            union = w * h + b[2, j] * b[3, j] - shared
            giou = shared / (union + small) - (hull - union) / (hull + small)
            distance = distance_x + distance_y + change_w + change_h
            cost[i, j] = l1 * distance - gain * giou
