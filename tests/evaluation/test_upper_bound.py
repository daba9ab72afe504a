"""The upper bound: each limit of the design costs what it must, and nothing else is lost."""

from __future__ import annotations

import pytest
import torch
from hydra.utils import instantiate

from model_factory import small_batch, tiny_config, tiny_model
from occdetr.evaluation.upper_bound import LIMITS, UpperBound, coarsen, kept_voxels


def upper_bound(partition: str = "mixed", overrides: tuple[str, ...] = ()) -> UpperBound:
    config = tiny_config(partition, overrides=overrides)
    return UpperBound(tiny_model(partition, overrides), instantiate(config.loss.occupancy))


@pytest.mark.parametrize("partition", ["mixed", "all_foreground", "all_background"])
def test_without_limits_a_perfect_network_is_perfect(partition: str) -> None:
    measured = upper_bound(partition)
    batch = small_batch(1, objects=partition != "all_background")
    measured.update(batch)
    results = measured.results()
    assert results["none"]["mIoU_present"] == pytest.approx(1)
    assert results["none"]["IoU"] == 1
    assert all(results["all"]["IoU"] <= results[name]["IoU"] for name in LIMITS)


def test_voxels_that_nobody_answers_for() -> None:
    batch = small_batch(1)
    assert batch.labels is not None
    batch.labels[0, 200:202, 10, 5] = 1  # two voxels of a car that is no object
    counts = {}
    for rule in ("unclaimed", "background"):
        measured = upper_bound(overrides=(f"loss.occupancy.background_voxels={rule}",))
        measured.update(batch)
        counts[rule] = measured.metrics["objects"].confusion
    assert counts["unclaimed"][0, 1] == 0
    assert counts["background"][0, 1] == 2  # said to be empty
    assert counts["background"][1, 1] == counts["unclaimed"][1, 1] - 2


def test_slots_go_to_the_nearest_objects() -> None:
    batch = small_batch(1)
    measured = upper_bound(overrides=("model.slots.num_slots=1",))
    measured.update(batch)
    per_class = measured.results()["slots"]["per_class"]
    assert per_class["car"] == pytest.approx(1)  # the first target
    assert per_class["pole"] == 0


def test_finer_cells_lose_less_of_an_object() -> None:
    found = {}
    for cells in (8, 32):
        measured = upper_bound(overrides=(f"model.occupancy_decoder.objects.cells={cells}",))
        measured.update(small_batch(1))
        found[cells] = measured.results()["object cells"]["per_class"]["car"]
    assert 0.3 < found[8] < found[32] <= 1


def test_kept_voxels_are_those_of_the_fullest_cells() -> None:
    kept = "model.occupancy_decoder.background.kept=[2,2,1]"
    decoder = tiny_model(overrides=(kept,)).occupancy_decoder
    occupied = torch.zeros(1, 256, 256, 32, dtype=torch.bool)
    occupied[0, 0:2, 0:2, 0] = True  # 4 voxels of one 0.4 m cell
    occupied[0, 100, 100, 0:2] = True  # 2 of another
    occupied[0, 200, 200, 0] = True  # 1 elsewhere, lost to the first level's two places
    found = kept_voxels(occupied, decoder)
    assert (occupied & found).sum() == 4  # the last level keeps one cell
    assert found.sum() == 8
    assert found[0, 0:2, 0:2, 0:2].all()


def test_coarse_cells_take_their_commonest_class() -> None:
    grid = torch.zeros(1, 4, 4, 4, dtype=torch.uint8)
    grid[0, 0, 0, 0], grid[0, 1, 0, 0], grid[0, 1, 1, 0] = 9, 15, 15
    coarse = coarsen(grid, 2)
    assert (coarse[0, :2, :2, :2] == 15).all()
    assert (coarse > 0).sum() == 8
    assert torch.equal(coarsen(grid, 1), grid)
