"""What ``precision=auto`` takes."""

import os
from functools import partial
from typing import Any

import lightning
import pytest
import torch

from occdetr.train import precision_of_auto
from occdetr.training import precision
from occdetr.training.checkpoint import Checkpoint
from occdetr.training.precision import CHOICE, median_ratio, resolve_precision
from occdetr.training.trainer import make_trainer

OF_CPU = CHOICE.format("cpu")


@pytest.fixture(autouse=True)
def undecided(monkeypatch):
    monkeypatch.setenv(OF_CPU, "")  # so that it is as before after the test
    monkeypatch.delenv(OF_CPU)
    monkeypatch.setattr(precision, "computes_bf16", lambda accelerator: True)


def never():
    raise AssertionError("timed")


@pytest.mark.parametrize(("speedup", "expected"), [(1.31, "bf16-mixed"), (1.29, "32-true")])
def test_bf16_has_to_be_clearly_faster(speedup, expected, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(precision, "bf16_speedup", lambda: speedup)
    keywords: Any = {"accelerator": "cpu", "precision": "auto"}
    settings = partial(lightning.Trainer, **keywords)
    assert make_trainer(settings, tmp_path).precision == expected
    assert f"trainer.precision=auto: {expected}: bf16 is {speedup}" in capsys.readouterr().out


def test_a_processor_without_bf16_and_a_given_precision_are_not_timed(monkeypatch):
    monkeypatch.setattr(precision, "computes_bf16", lambda accelerator: False)
    monkeypatch.setattr(precision, "bf16_speedup", never)
    assert resolve_precision("auto", "cpu") == "32-true"
    assert resolve_precision("16-mixed", "cpu") == "16-mixed"


def test_a_gpu_is_asked_alone(monkeypatch):
    monkeypatch.setenv(CHOICE.format("cuda"), "")
    monkeypatch.delenv(CHOICE.format("cuda"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(precision, "bf16_speedup", never)
    assert resolve_precision("auto", "auto") == "bf16-mixed"


def test_ranks_that_it_starts_take_the_choice_of_the_first(monkeypatch):
    monkeypatch.setattr(precision, "bf16_speedup", lambda: 2.0)
    assert resolve_precision("auto", "cpu") == "bf16-mixed"
    assert os.environ[OF_CPU] == "bf16-mixed"  # which they inherit
    monkeypatch.setattr(precision, "bf16_speedup", never)
    assert resolve_precision("auto", "cpu") == "bf16-mixed"


@pytest.mark.parametrize("rank", [0, 1])
def test_ranks_started_from_outside_get_the_choice_of_the_first(rank, monkeypatch):
    def broadcast(values):
        values[:] = ["bf16-mixed"] if rank else values

    group = {
        "is_available": lambda: True,
        "is_initialized": lambda: True,
        "get_rank": lambda: rank,
        "broadcast_object_list": broadcast,
    }
    for name, function in group.items():
        monkeypatch.setattr(precision.dist, name, function)
    monkeypatch.setattr(precision, "bf16_speedup", never if rank else lambda: 2.0)
    assert resolve_precision("auto", "cpu") == "bf16-mixed"


@pytest.mark.parametrize("saved", ["bf16-mixed", "32-true"])
def test_a_resumed_run_is_not_timed(saved, monkeypatch, tmp_path):
    monkeypatch.setattr(precision, "bf16_speedup", never)
    begun = Checkpoint(tmp_path, {"trainer": {"precision": saved}}, "full", "", {})
    assert precision_of_auto("cpu", begun) == saved


def test_the_median_of_the_ratios_in_turn_counts():
    """One pair of eight is disturbed, and the warm-up is not counted."""
    seconds = iter([9.0, 1.0, *([1.0, 2.0] * 6), 50.0, 1.0])
    now = 0.0

    def work():
        nonlocal now
        now += next(seconds)

    assert median_ratio(work, work, lambda: now) == 0.5


def test_timing_leaves_the_random_numbers_alone():
    before = torch.get_rng_state()
    assert precision.bf16_speedup() > 0
    assert torch.equal(torch.get_rng_state(), before)
