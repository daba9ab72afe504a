"""The parts of the occupancy decoder and mask head that save arithmetic: nothing else changes."""

from __future__ import annotations

import pytest
import torch

from occdetr.geometry.subdivision import all_cells
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.models.attention_keys import pooled_keys
from occdetr.models.box_encoding import BoxEncoder
from occdetr.models.layers import Attention, FewQueryAttention
from occdetr.models.occupancy_queries import Queries


@pytest.mark.parametrize("shape", [(16, 16, 2), (64, 32, 8), (256, 256, 32)])
def test_cells_are_encoded_like_their_boxes(shape: tuple[int, int, int]) -> None:
    torch.manual_seed(0)
    encoder = BoxEncoder(16).double()
    cells = torch.stack([torch.randint(side, (2, 50)) for side in shape], dim=-1)
    size = torch.tensor(GRID_SHAPE).double() * VOXEL_SIZE / torch.tensor(shape)
    center = torch.tensor(GRID_ORIGIN, dtype=torch.double) + (cells + 0.5) * size
    boxes = torch.cat([center, size.expand_as(center)], dim=-1)
    assert torch.allclose(encoder.of_cells(cells, shape), encoder(boxes), atol=1e-9)
    values = [encoder(boxes).sum(), encoder.of_cells(cells, shape).sum()]
    gradients = [torch.autograd.grad(v, list(encoder.parameters())) for v in values]
    for of_boxes, of_cells in zip(*gradients, strict=True):
        assert torch.allclose(of_boxes, of_cells, atol=1e-9)


def test_few_queries_attend_like_many() -> None:
    torch.manual_seed(0)
    few, usual = FewQueryAttention(24, 4).double(), Attention(24, 4).double()
    usual.load_state_dict(few.state_dict())
    query = torch.randn(2, 5, 24, dtype=torch.double, requires_grad=True)
    features = torch.randn(2, 60, 24, dtype=torch.double, requires_grad=True)
    expected, found = usual(query, features, features), few(query, features)
    assert torch.allclose(found, expected)
    for of_few, of_usual in zip(
        torch.autograd.grad(found.square().sum(), [query, features, *few.parameters()]),
        torch.autograd.grad(expected.square().sum(), [query, features, *usual.parameters()]),
        strict=True,
    ):
        assert torch.allclose(of_few, of_usual)


def test_keys_are_the_means_of_objects_and_regions() -> None:
    """Two objects of 8 children; cells of a 4 x 4 x 2 grid, in regions of 2 x 2 x 2 cells."""
    torch.manual_seed(0)
    cells = all_cells((4, 4, 2))
    cells = torch.stack([cells[:20], cells[12:]])  # frames 0 and 1 have different ones
    features = torch.randn(2, 16 + 20, 5)
    queries = Queries(features, torch.zeros(2, 36, 6), cells)
    used = torch.tensor([[True, False], [True, True]])
    keys, mask = pooled_keys(queries, used, (4, 4, 2), (2, 2, 1))
    assert keys.shape == (2, 2 + 4, 5)
    assert torch.allclose(keys[:, 1], features[:, 8:16].mean(1))
    for frame in range(2):
        region = 2 * (cells[frame, :, 0] // 2) + cells[frame, :, 1] // 2
        for index in range(4):
            inside = features[frame, 16:][region == index]
            assert mask[frame, 2 + index] == (len(inside) > 0)
            if len(inside):
                assert torch.allclose(keys[frame, 2 + index], inside.mean(0), atol=1e-6)
    assert torch.equal(mask[:, :2], used)
    assert not mask.all()


def test_sums_over_a_region_are_not_rounded_to_the_queries_type() -> None:
    """All of 1,000 queries in one region; in bf16 one more changes neither 256 nor 512."""
    torch.manual_seed(0)
    features = (1 + torch.rand(1, 1000, 4)).bfloat16()
    cells = torch.zeros(1, 1000, 3, dtype=torch.long)
    queries = Queries(features, torch.zeros(1, 1000, 6), cells)
    keys, mask = pooled_keys(queries, torch.ones(1, 0, dtype=torch.bool), (2, 2, 2), (1, 1, 1))
    assert keys.dtype == torch.bfloat16
    assert mask.all()
    assert torch.allclose(keys.float(), features.float().mean(1, keepdim=True), rtol=0.005)


def test_every_query_changes_what_others_attend_to() -> None:
    cells = all_cells((4, 4, 4))[None]
    features = torch.randn(1, 8 + 64, 3, requires_grad=True)
    queries = Queries(features, torch.zeros(1, 72, 6), cells)
    keys, _ = pooled_keys(queries, torch.ones(1, 1, dtype=torch.bool), (4, 4, 4), (2, 2, 2))
    (gradient,) = torch.autograd.grad(keys.sum(), features)
    assert (gradient > 0).all()
