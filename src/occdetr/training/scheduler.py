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

    def factor(self, step: int, total_steps: int) -> float:
        """What the learning rates are multiplied with at a step (from 0) of ``total_steps``."""
        rise = (step + 1) / (self.warmup_steps + 1)
        return max(min(rise, self.fall(step, total_steps), 1.0), 0.0)

    def fall(self, step: int, total_steps: int) -> float:
        """The factor without the warm-up."""
        return 1.0


@dataclass(frozen=True)
class Linear(Constant):
    """Linear to zero (paper IV-B) once the warm-up is over."""

    def fall(self, step: int, total_steps: int) -> float:
        return (total_steps - step) / max(total_steps - self.warmup_steps, 1)


@dataclass(frozen=True)
class Cosine(Constant):
    """Half a cosine to zero (Loshchilov and Hutter, "SGDR", 2017) once the warm-up is over."""

    def fall(self, step: int, total_steps: int) -> float:
        share = (step - self.warmup_steps) / max(total_steps - self.warmup_steps, 1)
        return (1 + math.cos(math.pi * min(max(share, 0.0), 1.0))) / 2


def make_scheduler(optimizer: Optimizer, schedule: Constant, total_steps: int) -> LambdaLR:
    """Moves the rates of all groups of ``optimizer`` after every step."""
    return LambdaLR(optimizer, lambda step: schedule.factor(step, total_steps))
