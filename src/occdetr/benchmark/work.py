"""Exponents of growth, and outputs with a number of objects to draw."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from occdetr.geometry.voxels import GRID_ORIGIN, VOXEL_SIZE
from occdetr.structures import OccupancyOutput

#: A slope of a line through noisy logarithms up to here counts as linear.
LINEAR = 1.1
CAR = (6.0, 3.0, 2.4)  # metres; an enlarged box


def exponent(work: Sequence[float], cost: Sequence[float]) -> float:
    """The e of cost = c * work^e, by least squares of the logarithms.

    A constant part of the cost makes it smaller: see ``last_exponent``.
    """
    return float(np.polyfit(np.log(work), np.log(np.maximum(cost, 1e-12)), 1)[0])


def last_exponent(work: Sequence[float], cost: Sequence[float]) -> float:
    """The exponent between the two largest works, where a constant part matters least."""
    return exponent(work[-2:], cost[-2:])


def no_worse_than_linear(work: Sequence[float], cost: Sequence[float]) -> bool:
    """Whether both exponents are at most 1, but for noise."""
    return max(exponent(work, cost), last_exponent(work, cost)) <= LINEAR


def with_objects(output: OccupancyOutput, count: int) -> OccupancyOutput:
    """The same output with ``count`` certain objects, of a car's size and side by side, in its
    first slots, and none in the others."""
    slots = output.slots
    assert slots is not None
    index = torch.arange(slots.scores.shape[1], device=slots.scores.device)
    place = torch.stack([index % 8, index // 8 % 16, torch.zeros_like(index)], dim=-1)
    size = slots.boxes3d.new_tensor(CAR)
    corner = slots.boxes3d.new_tensor(GRID_ORIGIN) + 4 * VOXEL_SIZE
    boxes = torch.cat([corner + (place + 0.5) * size, size.expand(len(index), 3)], dim=-1)
    certain = (index < count).to(slots.scores.dtype)
    drawn = dataclasses.replace(
        slots,
        scores=certain.expand_as(slots.scores),
        boxes3d=boxes.expand_as(slots.boxes3d),
    )
    return dataclasses.replace(output, slots=drawn)
