"""Averages of weights."""

from __future__ import annotations

import pytest
import torch
from torch.optim.swa_utils import AveragedModel

from occdetr.errors import InputError
from occdetr.training.callbacks import WeightAveraging


@pytest.mark.parametrize("steps", [30, 300])
def test_an_average_of_weights_soon_forgets_those_before_training(steps: int) -> None:
    weights = torch.nn.Linear(1, 1, bias=False)
    average = AveragedModel(weights, **WeightAveraging(decay=0.999)._kwargs)
    for step in range(steps):
        torch.nn.init.constant_(weights.weight, min(step, 1))
        average.update_parameters(weights)
    assert average.module.weight.item() > 0.999


@pytest.mark.parametrize(("age", "expected"), [(0.5, 0.505), (0.1, 0.9), (0.0, 1.0)])
def test_the_age_of_an_average_is_a_share_of_the_steps(age: float, expected: float) -> None:
    """The weights are 0.01 after the first step, 0.02 after the second, ..., 1 after the last."""
    weights = torch.nn.Linear(1, 1, bias=False)
    average = AveragedModel(weights, **WeightAveraging(age=age)._kwargs)
    for step in range(100):
        torch.nn.init.constant_(weights.weight, (step + 1) / 100)
        average.update_parameters(weights)
    assert average.module.weight.item() == pytest.approx(expected, abs=0.02)
    with pytest.raises(InputError, match=r"callbacks.ema.age=1"):
        WeightAveraging(age=1.0)


def test_an_average_of_weights_follows_its_decay() -> None:
    weights = torch.nn.Linear(1, 1, bias=False)
    average = AveragedModel(weights, **WeightAveraging(decay=0.5)._kwargs)
    torch.nn.init.zeros_(weights.weight)
    for _ in range(20):
        average.update_parameters(weights)
    torch.nn.init.ones_(weights.weight)
    average.update_parameters(weights)
    assert average.module.weight.item() == 0.5
    with pytest.raises(InputError, match=r"callbacks.ema.decay=1"):
        WeightAveraging(decay=1.0)
