"""What a part of the network costs, by hand and in sum."""

import pytest
import torch
from torch import nn

from model_factory import small_batch, tiny_model
from occdetr.evaluation import parts
from occdetr.evaluation.parts import REST, WHOLE, CostMeter, count_parts, tensor_bytes, time_parts
from occdetr.structures import Memory


@pytest.fixture(scope="module")
def model():
    return tiny_model().eval()


def test_the_parts_make_the_whole_and_leave_the_model_as_it_was(model):
    trainable = [parameter.requires_grad for parameter in model.parameters()]
    batch = small_batch(1)
    costs = count_parts(model, batch)
    assert list(costs) == [
        *("backbone", "encoder", "detector", "occupancy_decoder", "mask_head", "fusion", "whole")
    ]
    whole = costs.pop(WHOLE)
    assert whole.macs == sum(cost.macs for cost in costs.values()) > 1e8
    assert whole.operator_bytes >= sum(cost.operator_bytes for cost in costs.values())
    images, weights = tensor_bytes(batch.images), tensor_bytes(list(model.parameters()))
    assert images + weights < whole.least_bytes < 1.2 * (images + weights) + 256 * 256 * 32
    assert [parameter.requires_grad for parameter in model.parameters()] == trainable
    twice = count_parts(model, small_batch(2))
    # the tables of the encoding of cells are made once for a batch
    assert 1.998 * whole.macs < twice[WHOLE].macs < 2 * whole.macs


def test_bytes_of_a_layer():
    """Of 4 bytes each: 2 x 3 inputs, 3 x 5 weights, 2 x 5 products, and as many again for relu."""
    layer = nn.Sequential(nn.Linear(3, 5, bias=False), nn.ReLU()).requires_grad_(False)
    x = torch.randn(2, 3)
    with CostMeter({"layer": layer}) as meter:
        layer(x.T.T.view(2, 3))  # views move nothing
    cost = meter.parts["layer"]
    assert cost.macs == 2 * 3 * 5
    assert cost.least_bytes == 4 * (6 + 15 + 10)
    assert cost.operator_bytes == 4 * (6 + 15 + 10 + 10 + 10)


def test_bytes_of_what_parts_exchange():
    tokens = torch.zeros(1, 10, 4)
    assert tensor_bytes([Memory(tokens, [(2, 5)]), {"again": tokens}]) == 160
    assert tensor_bytes(torch.zeros(1, 4).expand(100, 4)) == 16


def test_the_times_of_parts_and_rest_make_the_whole(model, monkeypatch):
    """By a clock that advances by a second whenever it is read."""
    seconds = iter(range(10_000))
    monkeypatch.setattr(parts, "synchronized_time", lambda device: float(next(seconds)))
    batch = small_batch(1)
    times, cpu_per_wall = time_parts(
        model, lambda: model.predict(batch), torch.device("cpu"), repeats=2, warmup=1
    )
    found = {name: time["latency_ms"] for name, time in times.items()}
    whole, rest = found.pop(WHOLE), found.pop(REST)
    assert found == dict.fromkeys(found, 1000.0)
    assert len(found) == 6
    assert (whole, rest) == (13_000.0, 7_000.0)
    assert cpu_per_wall > 0
    assert not any(module._forward_hooks for module in model.children())
