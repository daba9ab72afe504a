"""The convolution among the cells that exist."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from model_factory import small_batch, tiny_model
from occdetr.geometry.subdivision import all_cells
from occdetr.models.occdetr import OccupancyDETR
from occdetr.models.sparse_convolution import SparseConvolution, neighbour_indices
from occdetr.structures import SceneBatch

GRID = (6, 5, 4)


def some_cells(number: int) -> torch.Tensor:
    """Different cells for each of two frames, in no order."""
    torch.manual_seed(0)
    cells = all_cells(GRID)
    return torch.stack([cells[torch.randperm(len(cells))[:number]] for _ in range(2)])


def test_neighbours_are_those_beside_a_cell() -> None:
    cells = some_cells(50)
    found = neighbour_indices(cells, GRID)
    for frame in range(2):
        place = {tuple(cell): i for i, cell in enumerate(cells[frame].tolist())}
        for index, cell in enumerate(cells[frame].tolist()):
            for k, step in enumerate((all_cells((3, 3, 3)) - 1).tolist()):
                beside = tuple(a + b for a, b in zip(cell, step, strict=True))
                assert found[frame, index, k] == place.get(beside, 50)


def test_it_is_a_dense_convolution_where_missing_cells_are_zero() -> None:
    layer = SparseConvolution(8, 3).double()
    torch.nn.init.normal_(layer.expand.weight)
    torch.nn.init.normal_(layer.expand.bias)
    cells = some_cells(70)
    x = torch.randn(2, 70, 8, dtype=torch.double)
    found = layer(x, neighbour_indices(cells, GRID))
    inner = layer.reduce(layer.norm(x)).relu()
    kernel = layer.expand.weight.unflatten(1, (3, 3, 3, 3)).permute(0, 4, 1, 2, 3)
    for frame in range(2):
        dense = torch.zeros(*GRID, 3, dtype=torch.double)
        dense[tuple(cells[frame].T)] = inner[frame]
        all_of_it = F.conv3d(dense.permute(3, 0, 1, 2)[None], kernel, layer.expand.bias, padding=1)
        wanted = x[frame] + all_of_it[0][:, *cells[frame].T].T
        torch.testing.assert_close(found[frame], wanted)


def test_it_starts_as_the_identity_and_learns() -> None:
    layer = SparseConvolution(8, 3)
    x = torch.randn(2, 20, 8)
    neighbours = neighbour_indices(some_cells(20), GRID)
    torch.testing.assert_close(layer(x, neighbours), x)
    layer(x, neighbours).square().sum().backward()
    assert layer.expand.weight.grad is not None
    assert layer.expand.weight.grad.abs().sum() > 0


def test_without_a_width_the_decoder_has_none() -> None:
    setting = "model.occupancy_decoder.background.convolution_dim=null"
    assert tiny_model(overrides=[setting]).occupancy_decoder.convolutions is None


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_a_layer_changes_its_own_level_and_those_after_it(layer: int) -> None:
    """The last one comes after the last choice, so that it changes the finest voxels alone."""
    model, batch = tiny_model().eval(), small_batch(1)
    before = level_logits(model, batch)
    torch.nn.init.normal_(model.occupancy_decoder.convolutions[layer].expand.weight)
    after = level_logits(model, batch)
    same = [torch.equal(a, b) for a, b in zip(before, after, strict=True)]
    first = 3 if layer == 2 else layer
    assert same == [level < first for level in range(4)]


def level_logits(model: OccupancyDETR, batch: SceneBatch) -> list[torch.Tensor]:
    with torch.no_grad():
        return [level.logits for level in model(batch.images, batch.camera).occupancy.levels]
