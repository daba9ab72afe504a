"""Learning rates over a run: a short warm-up, then constant or down to zero."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from occdetr.errors import NOT_NEGATIVE, check_range


@dataclass(frozen=True)
class Constant:
    """The full rate to the end, after ``warmup_steps`` of linear rise."""

    warmup_steps: int = 0

    def __post_init__(self) -> None:
        check_range("scheduler.warmup_steps", self.warmup_steps, NOT_NEGATIVE)

    def factor(self, step: float, total_steps: float) -> float:
        """What the learning rates are multiplied with at a step (from 0) of ``total_steps``."""
        rise = (step + 1) / (self.warmup_steps + 1)
        return max(min(rise, self.fall(step, total_steps), 1.0), 0.0)

    def fall(self, step: float, total_steps: float) -> float:
        """The factor without the warm-up."""
        return 1.0


@dataclass(frozen=True)
class Linear(Constant):
    """Linear to zero (paper IV-B) once the warm-up is over."""

    def fall(self, step: float, total_steps: float) -> float:
        return (total_steps - step) / max(total_steps - self.warmup_steps, 1)


@dataclass(frozen=True)
class Cosine(Constant):
    """Half a cosine to zero (Loshchilov and Hutter, "SGDR", 2017) once the warm-up is over."""

    def fall(self, step: float, total_steps: float) -> float:
        share = (step - self.warmup_steps) / max(total_steps - self.warmup_steps, 1)
        return (1 + math.cos(math.pi * min(max(share, 0.0), 1.0))) / 2


@dataclass(frozen=True)
class Pace:
    """How far each optimizer step moves a run along its schedule.

    A schedule counts the steps of the run that began it, ``steps_per_epoch``. A resumed run with
    another batch size or number of devices takes other steps over the same samples: from its
    first, ``step``, where the schedule was at ``start``, each of its steps counts as ``rate``.
    """

    steps_per_epoch: int = 1
    start: float = 0
    step: int = 0
    rate: float = 1

    def position(self, step: int) -> float:
        """Where the schedule is before a step (from 0) of the run."""
        return self.start + (step - self.step) * self.rate

    def total_steps(self, epochs: int, max_steps: int) -> float:
        """The length of the schedule; each limit may be -1, which is none."""
        by_epochs = math.inf if epochs == -1 else self.steps_per_epoch * max(epochs, 1)
        return by_epochs if max_steps == -1 else min(by_epochs, self.position(max_steps))


def make_scheduler(
    optimizer: Optimizer, schedule: Constant, total_steps: float, pace: Pace | None = None
) -> LambdaLR:
    """Moves the rates of all groups of ``optimizer`` after every step."""
    position = (pace or Pace()).position
    return LambdaLR(optimizer, lambda step: schedule.factor(position(step), total_steps))
