"""Measuring functions: what they count, and on what."""

import dataclasses
import itertools
import time

import pytest
import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn import functional
from torch.utils.data import DataLoader, Dataset, SequentialSampler

from model_factory import camera
from occdetr.cli.entry import build, compose
from occdetr.evaluation.speed import macs_of, measure_alternating, measure_latency, measure_loading
from occdetr.models.deformable_attention import DeformableAttention
from occdetr.models.layers import Attention, AttentionSize
from occdetr.structures import Memory


@pytest.mark.parametrize("masked", [True, False])
def test_multiply_adds_of_attention(masked):
    """By hand: four projections, and queries times keys for the weights and for the values."""
    batch, queries, keys, dim = 2, 5, 7, 16
    query, key = torch.randn(batch, queries, dim), torch.randn(batch, keys, dim)
    mask = torch.ones(batch, keys, dtype=torch.bool) if masked else None
    projections = batch * (2 * queries + 2 * keys) * dim * dim
    expected = projections + 2 * batch * queries * keys * dim
    layer = Attention(dim, num_heads=4).requires_grad_(False)
    assert macs_of(lambda: layer(query, key, key, mask)) == expected


def test_multiply_adds_of_deformable_attention():
    """By hand: four projections, and four neighbours of every sampled value."""
    size = AttentionSize(16, num_heads=4, num_levels=2, num_points=3, feedforward_dim=32)
    shapes, queries, dim = [(4, 6), (2, 3)], 5, 16
    memory = Memory(torch.randn(1, 30, dim), shapes)
    samples = queries * 4 * 2 * 3  # of 4 channels
    projections = 30 * dim * dim + samples * dim * (2 + 1) + queries * dim * dim
    query, reference = torch.randn(1, queries, dim), torch.rand(1, queries, 4)
    layer = DeformableAttention(size).requires_grad_(False)
    assert macs_of(lambda: layer(query, reference, memory)) == projections + samples * 4 * 4


def test_backward_multiply_adds_are_twice_those_of_the_forward_pass():
    """Once for the gradient of each of the two factors; by hand for a convolution of each channel.

    Attention's has five products where the forward pass has two: it computes its weights again.
    """
    size = AttentionSize(16, num_heads=4, num_levels=2, num_points=3, feedforward_dim=32)
    memory = Memory(torch.randn(1, 30, 16, requires_grad=True), [(4, 6), (2, 3)])
    query = torch.randn(1, 5, 16, requires_grad=True)
    layer, place = DeformableAttention(size), torch.rand(1, 5, 4, requires_grad=True)
    forward = macs_of(lambda: layer(query, place, memory))
    assert macs_of(lambda: layer(query, place, memory).sum().backward()) == 3 * forward

    x = torch.randn(2, 8, 5, 7, requires_grad=True)
    convolution, forward = nn.Conv2d(8, 8, 3, padding=1, groups=8), 2 * 8 * 5 * 7 * 9
    assert macs_of(lambda: convolution(x).sum().backward()) == 3 * forward

    heads = torch.randn(2, 4, 6, 8, requires_grad=True)
    attend = functional.scaled_dot_product_attention
    forward = 2 * (2 * 4 * 6 * 6 * 8)
    assert macs_of(lambda: attend(heads, heads, heads).sum().backward()) == 3.5 * forward


@pytest.mark.parametrize(
    ("choice", "macs"), [("experiment=paper", 684.3e9), ("model=paper", 124.7e9)]
)
def test_multiply_adds_of_the_paper_sized_networks(choice, macs):
    """On the CPU, by shapes alone; fusion's are not among them."""
    given = ["stage=full", choice, "data=semantickitti", "model.backbone.weights=null"]
    config = compose("train", given)
    with FakeTensorMode(allow_non_fake_inputs=True):
        model = build(config.model).eval().requires_grad_(False)
        view = dataclasses.replace(camera(1), image_size=tuple(config.image_size))
        images = torch.zeros(1, 3, *config.image_size)
        assert macs_of(lambda: model(images, view)) == pytest.approx(macs, rel=1e-3)


def test_latency_leaves_out_the_warmup():
    seconds = itertools.chain([0.2], itertools.repeat(0.01))
    found = measure_latency(
        lambda: time.sleep(next(seconds)), torch.device("cpu"), repeats=4, warmup=1
    )
    assert found["repeats"] == 4
    low, high = found["latency_ms_quartiles"]
    assert 10 <= found["latency_ms_min"] <= low <= found["latency_ms"] <= high < 200


def test_functions_that_are_compared_run_in_turn():
    called = []
    calls = {name: lambda name=name: called.append(name) for name in "ab"}
    times, _ = measure_alternating(calls, torch.device("cpu"), repeats=3, warmup=1)
    assert "".join(called) == "ab" * 4
    assert {name: len(seconds) for name, seconds in times.items()} == {"a": 3, "b": 3}


class SlowFrames(Dataset):
    def __len__(self):
        return 6

    def __getitem__(self, index):
        time.sleep(0.005)
        return index


class CountingSampler(SequentialSampler):
    def __init__(self, data):
        super().__init__(data)
        self.epochs = []

    def set_epoch(self, epoch):
        self.epochs.append(epoch)


def test_loading_continues_with_the_next_epoch():
    frames = SlowFrames()
    sampler = CountingSampler(frames)
    loader = DataLoader(frames, batch_size=2, sampler=sampler)
    found = measure_loading(loader, samples=4, repeats=3, warmup=1, description="")
    assert sampler.epochs == [0, 1, 2]  # 4 rounds of 2 batches; an epoch has 3
    assert found["samples"] == 12
    low, high = found["quartiles"]
    assert 0 < low <= found["samples_per_second_per_worker"] <= high <= 1 / 0.005
