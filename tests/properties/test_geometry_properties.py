"""Boxes and boxes' projections of any size and place."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model_factory import camera
from occdetr.data.early_matching import match_rois
from occdetr.geometry.boxes import (
    bounds_in_grid,
    box_iou,
    boxes3d_to_camera,
    boxes3d_to_grid,
    cxcywh_to_xyxy,
    enlarge_boxes3d,
    generalized_box_iou,
    xyxy_to_cxcywh,
)
from occdetr.geometry.subdivision import child_boxes, project_boxes, project_centers

quick = settings(max_examples=30, deadline=None, derandomize=True)
center = st.floats(-60, 60, width=32)
size = st.one_of(st.just(0.0), st.floats(2**-20, 60, width=32))


def boxes_of(axes: int, least: int = 1) -> st.SearchStrategy[torch.Tensor]:
    """(centre, size) boxes, points and lines among them."""
    box = st.tuples(*[center] * axes, *[size] * axes)
    return st.lists(box, min_size=least, max_size=8).map(
        lambda rows: torch.tensor(rows, dtype=torch.float32).reshape(-1, 2 * axes)
    )


@quick
@given(boxes_of(3), boxes_of(3))
def test_overlaps_are_bounded_and_symmetric(a, b) -> None:
    iou, giou = (f(a[:, None], b[None]) for f in (box_iou, generalized_box_iou))
    assert torch.isfinite(giou).all()
    assert ((iou >= 0) & (iou <= 1 + 1e-5)).all()
    assert ((giou >= -1 - 1e-5) & (giou <= iou + 1e-5)).all()
    assert torch.allclose(giou, generalized_box_iou(b[:, None], a[None]).T, atol=1e-5)


@quick
@given(boxes_of(2), boxes_of(2))
def test_gradients_of_the_overlap_are_finite(a, b) -> None:
    a = a.requires_grad_()
    generalized_box_iou(a[:, None], b[None]).sum().backward()
    assert torch.isfinite(a.grad).all()


@quick
@given(boxes_of(2, least=0))
def test_corners_and_centres_are_inverse(boxes) -> None:
    assert torch.allclose(xyxy_to_cxcywh(cxcywh_to_xyxy(boxes)), boxes, atol=1e-4)


@quick
@given(boxes_of(3, least=0))
def test_boxes_of_grid_and_camera_are_inverse(boxes) -> None:
    transform = camera(1).lidar_to_camera[0]
    there = boxes3d_to_camera(boxes, transform)
    assert torch.allclose(boxes3d_to_grid(there, transform), boxes, atol=1e-3)
    bounds = bounds_in_grid(there[None], transform[None])[0]
    assert torch.allclose(bounds, boxes, atol=1e-3)  # the axes are parallel


@quick
@given(boxes_of(3), st.floats(1, 3), st.floats(0, 4))
def test_enlarged_boxes_hold_the_boxes(boxes, factor, least) -> None:
    larger = enlarge_boxes3d(boxes, factor, least)
    assert (larger[:, 3:] >= boxes[:, 3:] * 0.999).all()
    assert (larger[:, 3:] >= least * 0.999).all()


@quick
@given(boxes_of(3))
def test_projections_are_finite_and_in_their_range(boxes) -> None:
    projected = project_boxes(boxes[None], camera(1))
    assert torch.isfinite(projected).all()
    assert ((projected[..., :2] >= -1) & (projected[..., :2] <= 2)).all()
    assert ((projected[..., 2:] >= 0.01) & (projected[..., 2:] <= 1)).all()
    children = child_boxes(boxes[None])
    assert children.shape == (1, 8 * len(boxes), 6)
    assert torch.allclose(children[..., 3:].sum(1), 4 * boxes[:, 3:].sum(0), rtol=1e-4)
    assert torch.isfinite(project_centers(children, camera(1))).all()


@quick
@given(boxes_of(2, least=0), st.integers(1, 300))
def test_every_object_gets_a_token_of_its_own_while_there_are_any(boxes, tokens) -> None:
    rois = np.random.default_rng(0).random((tokens, 4), dtype=np.float32)
    matched = match_rois(boxes.numpy(), rois)
    assert matched.shape == (len(boxes),)
    given_out = matched[matched >= 0]
    assert len(given_out) == min(len(boxes), tokens)
    assert len(set(given_out.tolist())) == len(given_out)
    assert (given_out < tokens).all()
