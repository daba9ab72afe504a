"""Times of a training step by action."""

import pytest
import torch

from occdetr.training import step_speed
from occdetr.training.step_speed import STEP, StepProfiler


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(step_speed, "synchronized_time", lambda device: now[0])
    return now


def test_an_action_does_not_count_those_inside_of_it(clock):
    profiler = StepProfiler(torch.device("cpu"))

    def spend(name, seconds, inside=()):
        with profiler.profile(name):
            clock[0] += seconds
            for each in inside:
                spend(*each)

    for _ in range(3):
        closure = [("[Strategy]One.training_step", 3.0, [("backbone", 5.0)]), ("a.backward", 7.0)]
        spend("[Loop].train_dataloader_next", 1.0)
        clock[0] += 0.5  # of no action
        spend("run_training_batch", 0.25, [("[Module]M.optimizer_step", 2.0, closure)])
    expected = {
        **{"train_dataloader_next": 1.0, "run_training_batch": 0.25, "optimizer_step": 2.0},
        **{"training_step": 3.0, "backbone": 5.0, "backward": 7.0, STEP: 18.75},
    }
    assert profiler.steps == [expected, expected]
