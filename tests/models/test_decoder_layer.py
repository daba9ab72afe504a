"""Which queries others attend to, and the clamp of the box head."""

from __future__ import annotations

import pytest
import torch

from model_factory import camera, tiny_model
from occdetr.models.decoder_layer import DecoderLayer, chosen_keys
from occdetr.models.detector import unproject_boxes3d
from occdetr.models.layers import AttentionSize, clamp_inward
from occdetr.structures import Memory

CPU = torch.device("cpu")


@pytest.mark.parametrize(("stride", "first"), [(2, [0, 2, 4, 6]), (4, [0, 4]), (8, [0])])
def test_spread_keys_are_every_octant_equally_often(stride, first) -> None:
    """Query 8 q + i is octant i of its parent."""
    octants = torch.arange(8 * 640) % 8
    assert octants[chosen_keys(len(octants), stride, "first", CPU)].unique().tolist() == first
    spread = chosen_keys(len(octants), stride, "spread", CPU)
    assert torch.equal(spread // stride, torch.arange(len(octants) // stride))  # one of each row
    counts = octants[spread].bincount(minlength=8)
    assert counts.min() > 0.9 * counts.max()


@pytest.mark.parametrize("count", [1, 7, 8, 1001])
def test_spread_keys_of_any_number_of_queries(count) -> None:
    keys = chosen_keys(count, 8, "spread", CPU)
    assert len(keys) == len(torch.arange(count)[::8])
    assert len(keys.unique()) == len(keys)
    assert keys.max() < count
    assert chosen_keys(count, 1, "spread", CPU) == slice(None, None, 1)


def test_with_spread_keys_children_of_every_octant_are_attended_to() -> None:
    torch.manual_seed(0)
    size = AttentionSize(hidden_dim=16, num_heads=2, num_levels=1, num_points=1, feedforward_dim=16)
    query = torch.randn(1, 8 * 32, 16, requires_grad=True)
    memory = Memory(torch.randn(1, 6, 16), [(2, 3)])
    layer = DecoderLayer(size, 8, key_choice="spread")
    out = layer(query, torch.zeros_like(query), torch.rand(1, 8 * 32, 4), memory)
    (out[0, 5] * torch.randn(16)).sum().backward()
    felt = query.grad[0].abs().sum(1).nonzero().squeeze(1)
    assert (felt[felt != 5] % 8).unique().tolist() == list(range(8))


def test_the_choice_of_keys_is_a_setting() -> None:
    model = tiny_model(overrides=("model.occupancy_decoder.key_choice=spread",))
    layers = model.occupancy_decoder.layers
    assert [(layer.key_stride, layer.key_choice) for layer in layers] == [
        (stride, "spread") for stride in (1, 2, 8)
    ]


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
