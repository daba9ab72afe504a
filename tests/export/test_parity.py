"""The comparison of an exported network with the network itself."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from occdetr.export.parity import compare


@pytest.fixture
def output() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    grid = torch.zeros(1, 256, 256, 32, dtype=torch.uint8)
    grid[:, :, 100:150, 1] = 9  # a road
    grid[:, 50:70, 120:129, 2:10] = 1  # a car
    return {
        "grid": grid,
        "boxes_xyxy": torch.rand(1, 20, 4, generator=generator) * 100,
        "boxes3d": torch.rand(1, 20, 6, generator=generator) * 50,
        "scores": torch.rand(1, 20, generator=generator),
        "classes": torch.randint(1, 20, (1, 20), generator=generator),
    }


def test_equal_outputs_are_equal_in_any_order(output: dict[str, Tensor]) -> None:
    order = torch.randperm(20, generator=torch.Generator().manual_seed(1))
    other = {k: x if k == "grid" else x[:, order] for k, x in output.items()}
    parity = compare(output, other)
    assert parity.failure is None
    assert (parity.voxels, parity.occupied_voxels, parity.objects["classes"]) == (1, 1, 1)
    assert max(parity.objects[key] for key in ("boxes_xyxy", "boxes3d", "scores")) == 0


def test_differences_are_the_largest(output: dict[str, Tensor]) -> None:
    other = {key: value.clone() for key, value in output.items()}
    other["boxes_xyxy"][0, 3, 1] += 0.5
    other["boxes3d"][0, 4, 2] -= 0.25
    other["scores"][0, 5] += 0.125
    other["classes"][0, 6] += 1
    objects = compare(output, other).objects
    assert objects == pytest.approx(
        {"boxes_xyxy": 0.5, "boxes3d": 0.25, "scores": 0.125, "classes": 0.95}, abs=1e-5
    )


def test_a_missing_object_is_a_failure(output: dict[str, Tensor]) -> None:
    """It has less than a thousandth of the voxels."""
    other = output | {"grid": torch.where(output["grid"] == 1, 0, output["grid"])}
    parity = compare(output, other)
    assert parity.voxels > 0.999
    assert "of the occupied voxels" in str(parity.failure)


def test_many_other_voxels_are_a_failure(output: dict[str, Tensor]) -> None:
    other = output | {"grid": output["grid"].roll(1, dims=3)}
    assert "99.9%" in str(compare(output, other).failure)


@pytest.mark.parametrize("name", ["boxes_xyxy", "boxes3d", "scores", "classes"])
def test_other_objects_are_a_failure(name: str, output: dict[str, Tensor]) -> None:
    """Also where the grid shows none of them, as that of a pretraining."""
    moved = output[name].clone()
    moved[:, :3] += 3
    assert "85% of the objects agree" in str(compare(output, output | {name: moved}).failure)
    one = output[name].clone()
    one[:, 0] += 3
    assert compare(output, output | {name: one}).failure is None


def test_numbers_that_are_not_finite_are_a_failure(output: dict[str, Tensor]) -> None:
    other = output | {"scores": output["scores"] * torch.nan}
    assert "not finite" in str(compare(output, other).failure)


def test_a_grid_alone(output: dict[str, Tensor]) -> None:
    alone = {"grid": torch.zeros_like(output["grid"])}
    parity = compare(alone, alone)
    assert (parity.failure, parity.occupied_voxels, parity.objects) == (None, 1, {})
