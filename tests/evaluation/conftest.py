"""The scene in which the tests of the diagnosis plant errors; tests only read it."""

from __future__ import annotations

import pytest
from torch import Tensor

from model_factory import small_batch
from occdetr.evaluation.upper_bound import LIMITS, UpperBound
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.losses.targets import SceneTruth
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import SceneBatch
from planted_errors import network


@pytest.fixture(scope="session")
def scene() -> tuple[OccupancyDETR, OccupancyCriterion, SceneBatch, Tensor]:
    """Network, criterion, a batch of two equal frames, and the grid of the upper bound."""
    # cells enough for the whole background
    enough = ("model.occupancy_decoder.background.kept=[2048,6144,24576]",)
    model, criterion = network("mixed", enough)
    batch = small_batch(2)
    assert batch.labels is not None
    assert batch.targets is not None
    bound = UpperBound(model, criterion)
    grid = bound.perfect_grid(SceneTruth.of_batch(batch).frame(0), LIMITS)
    return model, criterion, batch, grid
