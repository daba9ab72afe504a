"""The clamp of the box head, and ReLU in place."""

from __future__ import annotations

import torch

from model_factory import camera
from occdetr.models.detector import unproject_boxes3d
from occdetr.models.layers import clamp_inward, relu


def test_clamped_values_find_back() -> None:
    values = torch.tensor([-9.0, -4.0, -1.5, 0.0, 4.0, 7.0], requires_grad=True)
    clamped = clamp_inward(values, 4.0)
    assert torch.equal(clamped, values.clamp(-4.0, 4.0))
    for sign, expected in ((1.0, [0.0, 1, 1, 1, 1, 1]), (-1.0, [1.0, 1, 1, 1, 1, 0])):
        (gradient,) = torch.autograd.grad(sign * clamped.sum(), values, retain_graph=True)
        assert (sign * gradient).tolist() == expected  # a step goes against the gradient


def test_a_depth_and_a_size_out_of_range_are_learnt() -> None:

    raw = torch.tensor([0.0, 0.0, 5.0, 5.0, -5.0, 0.0]).repeat(1, 1, 1).requires_grad_()
    optimizer = torch.optim.SGD([raw], lr=0.05)
    boxes = torch.full((1, 1, 4), 0.5)
    truth = torch.tensor([15.0, 2.0, 2.0, 2.0]).log()
    for _ in range(150):
        found = unproject_boxes3d(raw, boxes, camera(1))[0, 0, 2:].log()
        optimizer.zero_grad()
        (found - truth).abs().sum().backward()
        optimizer.step()
    assert torch.allclose(found, truth, atol=0.1)


def test_relu_is_in_place_only_where_no_gradient_is_needed() -> None:
    values = torch.tensor([-1.0, 2.0])
    assert relu(values).tolist() == [0.0, 2.0]
    assert values.tolist() == [-1.0, 2.0]
    with torch.no_grad():
        assert relu(values).data_ptr() == values.data_ptr()
    assert values.tolist() == [0.0, 2.0]
