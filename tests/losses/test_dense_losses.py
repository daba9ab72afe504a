"""Losses in static shapes against the same terms frame by frame, values and gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import reference_losses as reference
from model_factory import box_target, small_batch, tiny_stage
from occdetr.losses import mask_sums as module
from occdetr.losses.mask_sums import MaskSums, mask_sums
from occdetr.losses.occupancy import class_counts
from occdetr.losses.targets import SceneTruth
from occdetr.structures import (
    BackgroundLevel,
    LayerDetections,
    OccupancyOutput,
    Slots,
    empty_target,
)

QUERIES = 7


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def assert_same(found: dict[str, Tensor], expected: dict[str, Tensor], leaves: list[Tensor]):
    """Every term and its gradients, relative to the largest one."""
    assert set(found) == set(expected)
    anchor = 0 * sum(leaf.sum() for leaf in leaves)
    for name, value in found.items():
        assert value.item() == pytest.approx(expected[name].item(), rel=2e-6, abs=1e-7), name
        kept = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
        both = (value, expected[name] + anchor)
        pairs = [torch.autograd.grad(each, leaves, **kept) for each in both]
        for one, other in zip(*pairs, strict=True):
            assert (one - other).abs().max() <= 2e-6 * other.abs().max().clamp(min=1e-6), name


@pytest.fixture(scope="module")
def stage():
    return tiny_stage("full")


@pytest.mark.parametrize("labels", ["scene", "empty", "unknown"])
def test_mask_terms(stage, labels: str) -> None:
    batch, criterion = small_batch(2), stage.occupancy_criterion
    classes = criterion.background_classes(SceneTruth.of_batch(batch))
    classes = {"scene": classes, "empty": classes * 0, "unknown": classes | 255}[labels]
    voxels = 9000  # several blocks; the upper part is unknown
    places = torch.stack([torch.randperm(256 * 100 * 30)[:voxels] for _ in range(2)])
    places = torch.stack([places // 3000, 100 + places // 30 % 100, places % 30], -1)
    logits = (8 * uniform(2, 19, voxels) - 4).requires_grad_()
    occupancy = (8 * uniform(2, voxels, seed=1) - 4).requires_grad_()
    output = OccupancyOutput(None, None, [], BackgroundLevel(places, occupancy, 1), logits)
    expected = reference.mask_terms(criterion, output, classes)
    assert_same(criterion.mask_losses(output, classes), expected, [logits, occupancy])


def compared_sums(logits: Tensor, occupancy: Tensor, index: Tensor, monkeypatch) -> list[MaskSums]:
    """The sums by blocks, and those by plain formulas."""
    blockwise = mask_sums(logits, occupancy, index)
    with monkeypatch.context() as patch:
        patch.setattr(module._BlockwiseSums, "apply", module.sums_over_classes)
        return [blockwise, mask_sums(logits, occupancy, index)]


def test_gradients_of_the_mask_sums(monkeypatch) -> None:
    monkeypatch.setattr(module, "BLOCK", 4)
    logits = (12 * uniform(2, 3, 10) - 6).double().requires_grad_()
    occupancy = (uniform(2, 10) - 0.5).double().requires_grad_()
    index = torch.randint(-2, 3, (2, 10), generator=torch.Generator().manual_seed(0))

    def sums(*given: Tensor) -> tuple[Tensor, ...]:
        return mask_sums(*given, index)[:-1]  # the count has no gradient

    assert torch.autograd.gradcheck(sums, (logits, occupancy))
    for found, expected in zip(*compared_sums(logits, occupancy, index, monkeypatch), strict=True):
        assert torch.allclose(found, expected, rtol=1e-12)


def test_mask_sums_of_large_logits_and_half_precision(monkeypatch) -> None:
    logits = torch.tensor([[[-200.0, 200.0, 90.0], [0.0, -100.0, 70.0]]], dtype=torch.bfloat16)
    logits, occupancy = logits.requires_grad_(), torch.zeros(1, 3, dtype=torch.bfloat16)
    index = torch.tensor([[0, 1, 1]])
    blockwise, dense = compared_sums(logits, occupancy, index, monkeypatch)
    for found, expected in zip(blockwise, dense, strict=True):
        assert found.dtype == torch.float32
        assert torch.isfinite(found).all()
        assert torch.allclose(found, expected)
    gradient = torch.autograd.grad(sum(x.sum() for x in blockwise), logits)[0]
    assert gradient.dtype == torch.bfloat16
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("slots", [2, 5])
def test_foreground_terms(stage, slots: int) -> None:
    """The objects of a frame with few and with many slots, one of them without a slot."""
    batch, criterion = small_batch(2), stage.occupancy_criterion
    truth = SceneTruth.of_batch(batch)
    boxes = box_target().boxes3d_grid * torch.tensor([1, 1, 1, 1.5, 1.5, 1.5])
    boxes = torch.cat([boxes, boxes + 0.4, boxes[:1] + 30])[:slots].expand(2, -1, -1)
    queries = torch.tensor([[3, 4, 1, 2, 0], [6, 1, 0, 2, 5]])[:, :slots]
    logits = (6 * uniform(2, slots, 8, 8, 8) - 3).requires_grad_()
    scores = torch.ones(2, slots)
    chosen = Slots(queries, scores, torch.ones(2, slots).long(), boxes.clone(), scores > 0)
    output = OccupancyOutput(chosen, logits, [], None, None)
    matches = [
        (torch.tensor([4, 3]), torch.tensor([1, 0])),
        (torch.tensor([1, 4]), torch.arange(2)),
    ]
    expected = reference.foreground_terms(criterion, output, truth, matches)
    assert_same(criterion.foreground_losses(output, truth, matches), expected, [logits])
    assert expected["foreground_dice"] > 0.1


@pytest.mark.parametrize("frames", ["objects", "some", "none"])
def test_detection_terms_of_two_layers(stage, frames: str) -> None:
    criterion = stage.detection_criterion
    classes = len(criterion.foreground_classes)
    first = empty_target() if frames == "none" else box_target()
    targets = [first, box_target() if frames == "objects" else empty_target()]
    layers = [
        LayerDetections(
            (4 * uniform(2, QUERIES, classes, seed=seed) - 2).requires_grad_(),
            (0.3 * uniform(2, QUERIES, 4, seed=seed) + 0.2).requires_grad_(),
            (10 * uniform(2, QUERIES, 6, seed=seed) + 0.1).requires_grad_(),
        )
        for seed in (0, 1)
    ]
    matches = criterion.match(layers, targets)
    count = max(sum(map(len, targets)), 1)
    found = criterion.layer_losses(layers, targets, matches, count)
    for index, (layer, own) in enumerate(zip(layers, matches, strict=True)):
        assert [len(queries) for queries, _ in own] == [len(target) for target in targets]
        ids, weights = criterion.foreground_classes, criterion.weights
        expected = reference.detection_terms(weights, layer, ids, targets, own)
        leaves = [layer.pred_logits, layer.pred_boxes, layer.pred_boxes3d]
        assert_same({name: value[index] for name, value in found.items()}, expected, leaves)


def test_voxels_are_counted_alike_where_bincount_would_wait(monkeypatch) -> None:
    classes = torch.randint(0, 20, (2, 8, 8, 4), generator=torch.Generator().manual_seed(0))
    classes[0, 0] = 255
    found = class_counts(classes.to(torch.uint8))
    assert found[0, 255] == 32
    assert (found[1, 3], found.sum()) == ((classes[1] == 3).sum(), 512)
    monkeypatch.setattr("torch.compiler.is_compiling", lambda: True)
    assert torch.equal(class_counts(classes.to(torch.uint8)), found)
