"""Fusion of background voxels and objects: both forms against a dense computation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from occdetr.evaluation.memory import tensor_memory_mb
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.models.fusion import LEAST_THRESHOLD, Fusion, write_voxels
from occdetr.models.object_writer import Interpolation, write_objects
from occdetr.models.occupancy_probability import occupancy_probability
from occdetr.structures import BackgroundLevel, OccupancyOutput, Slots

THRESHOLD = 0.35


def dense_weights(boxes: Tensor, axis: int, cells: int, interpolation: Interpolation) -> Tensor:
    """Weights of all voxels of an axis over all cells."""
    center = GRID_ORIGIN[axis] + (torch.arange(GRID_SHAPE[axis]) + 0.5) * VOXEL_SIZE
    size = boxes[:, 3 + axis, None].clamp(min=1e-3)
    place = (center - boxes[:, axis, None]) / size + 0.5
    cell = torch.arange(cells)
    if interpolation == "nearest":
        weight = ((place * cells).floor().clamp(0, cells - 1)[..., None] == cell).float()
    else:
        position = (place * cells - 0.5).clamp(0, cells - 1)
        weight = (1 - (position[..., None] - cell).abs()).clamp(min=0)
    return weight * ((place >= 0) & (place <= 1))[..., None]


def dense_occupancy(logits: Tensor, boxes: Tensor, interpolation: Interpolation) -> Tensor:
    """Every slot of a frame at every voxel of the grid."""
    x, y, z = (dense_weights(boxes, a, logits.shape[-1], interpolation) for a in range(3))
    values = torch.einsum("sijk,szk->sijz", logits.sigmoid(), z)
    values = torch.einsum("sijz,syj->siyz", values, y)
    return torch.einsum("siyz,sxi->sxyz", values, x)


def scene(batch: int, slots: int, cells: int = 6) -> dict[str, Tensor]:
    """Boxes that overlap, leave the grid, and hold no voxel's centre; not all are written."""
    generator = torch.Generator().manual_seed(3)
    center = torch.rand(batch, slots, 3, generator=generator) * torch.tensor([30.0, 20.0, 4.0])
    center = center + torch.tensor([-2.0, -10.0, -2.0])
    size = torch.rand(batch, slots, 3, generator=generator) * 9 + 0.5
    size[:, 1], size[:, 2, 0] = 0.01, 200.0
    center[:, 3] = 500.0
    return {
        "grid": torch.randint(0, 20, (batch, *GRID_SHAPE), generator=generator).byte(),
        "logits": 4 * torch.randn(batch, slots, cells, cells, cells, generator=generator),
        "boxes3d": torch.cat([center, size], -1),
        "classes": torch.randint(1, 20, (batch, slots), generator=generator),
        "written": torch.rand(batch, slots, generator=generator) > 0.2,
    }


class Writer(nn.Module):
    def __init__(self, interpolation: Interpolation) -> None:
        super().__init__()
        self.interpolation: Interpolation = interpolation

    def forward(self, **given: Tensor) -> Tensor:
        return write_objects(**given, threshold=THRESHOLD, interpolation=self.interpolation)


@pytest.mark.parametrize("interpolation", ["trilinear", "nearest"])
def test_objects_stand_where_the_dense_form_says(interpolation: Interpolation) -> None:
    given = scene(2, 5)
    before = given["grid"].clone()
    found = Writer(interpolation)(**given)
    assert torch.equal(given["grid"], before)
    for frame, grid in enumerate(before):
        inside = dense_occupancy(given["logits"][frame], given["boxes3d"][frame], interpolation)
        expected = grid.clone()
        for slot in reversed(range(5)):  # the first one is on top
            if given["written"][frame, slot]:
                expected[inside[slot] > THRESHOLD] = given["classes"][frame, slot].byte()
        clear = ((inside - THRESHOLD).abs() > 1e-5).all(0)
        assert clear.float().mean() > 0.999
        assert (expected != grid).sum() > 5_000
        assert torch.equal(found[frame][clear], expected[clear])


@pytest.mark.parametrize("interpolation", ["trilinear", "nearest"])
def test_probabilities_are_the_largest_of_background_and_objects(
    interpolation: Interpolation,
) -> None:
    given, generator = scene(2, 5), torch.Generator().manual_seed(5)
    scores = torch.rand(2, 5, generator=generator)
    slots = Slots(given["classes"], scores, given["classes"], given["boxes3d"], given["written"])
    place = torch.randperm(64**2, generator=generator)[:500]
    coordinates = torch.stack([place // 64, place % 64, place % 32], -1).expand(2, -1, -1)
    logits = torch.randn(2, 500, generator=generator)
    voxels = BackgroundLevel(coordinates, logits, 1)
    output = OccupancyOutput(slots, given["logits"], [], voxels, None)
    fusion = Fusion([9], 0.35, THRESHOLD, 0.3, interpolation)
    found = occupancy_probability(fusion, output)
    for frame in range(2):
        inside = dense_occupancy(given["logits"][frame], given["boxes3d"][frame], interpolation)
        kept = torch.where(scores[frame] > 0.3, scores[frame], 0.0)
        expected = (inside * kept[:, None, None, None]).amax(0)
        x, y, z = coordinates[frame].T
        expected[x, y, z] = torch.maximum(expected[x, y, z], logits[frame].sigmoid())
        assert (expected > 0).sum() > 5_000
        torch.testing.assert_close(found[frame], expected, atol=1e-6, rtol=1e-5)
    output = OccupancyOutput(slots, given["logits"], [], None, None)  # partition all_foreground
    assert (occupancy_probability(fusion, output) <= found).all()


@pytest.mark.parametrize("interpolation", ["trilinear", "nearest"])
def test_both_forms_write_the_same_classes_and_one_takes_no_more_memory_for_a_batch(
    interpolation: Interpolation, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, writer = scene(4, 5), Writer(interpolation)
    expected = writer(**given)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    assert torch.equal(writer(**given), expected)
    one = {name: values[:1] for name, values in given.items()}
    memory = [tensor_memory_mb(lambda g=g: writer(**g), torch.device("cpu")) for g in (one, given)]
    assert memory[1] < 1.7 * memory[0]


def test_an_exported_graph_gives_the_same_classes() -> None:
    """It holds PyTorch's form, and no Python loop over the slots."""
    given, writer = scene(1, 5), Writer("trilinear")
    exported = torch.export.export(writer, (), given)
    targets = {str(node.target) for node in exported.graph.nodes}
    assert not any("occdetr" in target for target in targets)
    assert len(exported.graph.nodes) < 320
    assert torch.equal(exported.module()(**given), writer(**given))


def test_no_object_leaves_the_background() -> None:
    given = scene(1, 4)
    unused = given | {"written": torch.zeros(1, 4, dtype=torch.bool)}
    broken = given | {"boxes3d": given["boxes3d"] * torch.nan}
    for none in (unused, broken):
        assert torch.equal(Writer("trilinear")(**none), given["grid"])


def test_an_object_is_written_where_its_box_is() -> None:
    logits = torch.full((1, 1, 8, 8, 8), -99.0)
    logits[0, 0, 4:] = 99.0  # the far half
    box = torch.tensor([[[10.0, 0.0, 0.0, 8.0, 4.0, 2.0]]])
    grid = torch.zeros(1, *GRID_SHAPE, dtype=torch.uint8)
    given = (grid, logits, box, torch.tensor([[5]]), torch.tensor([[True]]), 0.5)
    inside = write_objects(*given)[0].nonzero()
    assert inside.amin(0).tolist() == [50, 118, 5]  # x 10 m, y -2 m, z -1 m
    assert inside.amax(0).tolist() == [69, 137, 14]


def test_write_voxels_indexes_x_y_z() -> None:
    coordinates = torch.tensor([[[255, 0, 31], [1, 2, 3]]])
    grid = write_voxels(coordinates, torch.tensor([[7, 9]], dtype=torch.uint8))
    assert grid[0, 255, 0, 31] == 7
    assert grid[0, 1, 2, 3] == 9
    assert (grid > 0).sum() == 2


def iou(written: Tensor, truth: Tensor) -> float:
    return float((written & truth).sum() / (written | truth).sum())


@pytest.mark.parametrize("highest", [0.12, 0.4, 0.9])
def test_half_the_dice_is_near_the_best_threshold_of_a_class(highest: float) -> None:
    """Voxels occupied with a probability of 0 to ``highest``, which the network knows."""
    generator = torch.Generator().manual_seed(0)
    share = highest * torch.rand(50_000, generator=generator)
    truth = torch.rand(50_000, generator=generator) < share
    fusion = Fusion([9, 13], 0.35, 0.35, 0.2, class_thresholds=True)
    thresholds = fusion.class_thresholds
    assert thresholds is not None
    masks = torch.tensor([-20.0, 20.0])[None, :, None].expand(1, 2, 50_000)
    logits = share.logit()[None]
    before = fusion.background_classes(logits, masks)[0]
    assert torch.equal(before, 13 * (share > 0.35).byte())
    hits, written = (share * truth).sum(), share.sum() + truth.sum()
    for _ in range(3):
        thresholds.observe(torch.stack([hits * 0, hits])[None], torch.stack([hits, written])[None])
    assert thresholds()[0] == LEAST_THRESHOLD  # never found
    after = fusion.background_classes(logits, masks)[0] == 13
    best = max(iou(share > step / 100, truth) for step in range(100))
    assert iou(after, truth) > 0.9 * best


def test_a_voxel_is_written_as_the_class_that_exceeds_its_threshold_most() -> None:
    fusion = Fusion([9, 13], 0.35, 0.35, 0.2, class_thresholds=True)
    assert fusion.class_thresholds is not None
    fusion.class_thresholds.observe(torch.tensor([[0.5, 0.1]]), torch.ones(1, 2))
    probabilities = torch.tensor([[0.6, 0.4], [0.9, 0.1], [0.9, 0.1]])
    occupied = torch.tensor([[0.5, 0.8, 0.5]])
    classes = fusion.background_classes(occupied.logit(), probabilities.log().T[None])
    assert classes.tolist() == [[13, 9, 0]]  # 0.2 / 0.1, 0.72 / 0.5, 0.45 / 0.5
    before = fusion.class_thresholds()
    fusion.class_thresholds.observe(torch.tensor([[0.5, torch.nan]]), torch.ones(1, 2))
    assert torch.equal(fusion.class_thresholds(), before)
