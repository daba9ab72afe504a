"""Measuring functions: what they count, and on what."""

import itertools
import time

import torch
from torch.utils.data import DataLoader, Dataset, SequentialSampler

from model_factory import tiny_model
from occdetr.evaluation.speed import count_macs, example_batch, measure_latency, measure_loading


def test_the_example_batch_has_targets_for_a_training_step():
    batch = example_batch((64, 208), batch_size=2, classes=(1, 18))
    assert batch.images.shape == (2, 3, 64, 208)
    assert [target.classes.tolist() for target in batch.targets] == [[1, 18]] * 2


def test_multiply_adds_grow_with_the_batch_and_leave_the_model_as_it_was():
    model = tiny_model().eval()
    trainable = [parameter.requires_grad for parameter in model.parameters()]
    one, two = (
        count_macs(model, example_batch(model.image_size, batch_size, classes=(1,)))
        for batch_size in (1, 2)
    )
    assert one > 1e9
    assert two == 2 * one
    assert [parameter.requires_grad for parameter in model.parameters()] == trainable


def test_latency_leaves_out_the_warmup():
    seconds = itertools.chain([0.2], itertools.repeat(0.01))
    found = measure_latency(
        lambda: time.sleep(next(seconds)), torch.device("cpu"), repeats=4, warmup=1
    )
    assert found["repeats"] == 4
    low, high = found["latency_ms_quartiles"]
    assert 10 <= found["latency_ms_min"] <= low <= found["latency_ms"] <= high < 200


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
