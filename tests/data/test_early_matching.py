"""Early matching of objects to preset ROIs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment

from occdetr.data.early_matching import match_rois
from occdetr.geometry.boxes import generalized_box_iou
from occdetr.geometry.rois import preset_rois


def test_near_rois_are_matched_each_once() -> None:
    rois = preset_rois((128, 416), (8, 16, 32, 64), 2.0)
    assert len(rois) == 16 * 52 + 8 * 26 + 4 * 13 + 2 * 7
    boxes = rois[[100, 900, 1100]] + 1e-4
    assert match_rois(boxes, rois).tolist() == [100, 900, 1100]
    same = rois[[100, 100, 100]]
    found = match_rois(same, rois)
    assert 100 in found
    assert len(set(found.tolist())) == 3


@pytest.mark.parametrize("objects", [0, 1, 17])
def test_the_total_cost_is_minimal(objects: int) -> None:
    """Against the cost matrix of the losses' generalised IoU."""
    rois = preset_rois((64, 208), (8, 16), 2.0)
    rng = np.random.default_rng(objects)
    boxes = np.concatenate(
        [rng.uniform(0.2, 0.8, (objects, 2)), rng.uniform(0.02, 0.4, (objects, 2))], axis=1
    ).astype(np.float32)
    a, b = torch.from_numpy(boxes).double(), torch.from_numpy(rois).double()
    cost = 5 * torch.cdist(a, b, p=1) - 2 * generalized_box_iou(a[:, None], b[None])
    rows, columns = linear_sum_assignment(cost.numpy())
    found = match_rois(boxes, rois)
    assert len(set(found.tolist())) == objects
    expected = cost.numpy()[rows, columns].sum()
    assert cost.numpy()[np.arange(objects), found].sum() == pytest.approx(expected, abs=1e-4)
