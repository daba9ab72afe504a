"""Losses of both stages, fusion and metrics on frames of any content, degenerate ones included."""

from __future__ import annotations

import dataclasses
import functools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model_factory import small_batch, tiny_stage
from occdetr.data.early_matching import match_rois
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.detection import DetectionMetric
from occdetr.geometry.rois import preset_rois
from occdetr.models.fusion import Fusion
from occdetr.structures import BackgroundLevel, OccupancyOutput, SceneBatch, SceneTarget, Slots

few = settings(max_examples=4, deadline=None, derandomize=True)  # each runs a network
quick = settings(max_examples=15, deadline=None, derandomize=True)

#: A network with few tokens, queries, slots and voxels.
TINY = ("image_size=[32,64]", "model.occupancy_decoder.background.kept=[64,128,256]")
FEW = ("model.detector.selection.num_queries=12", "model.slots.num_slots=4")
CONTENTS = {"all unknown": 255, "all empty": 0, "all full": 13, "all car": 1}


@functools.cache
def stage_of(stage: str):
    module = tiny_stage(stage, overrides=(*TINY, *FEW))
    module.model.backbone.freeze_statistics()
    return module


def objects(count: int, box: tuple[float, float], seed: int = 0) -> SceneTarget:
    """Objects with image boxes and 3D boxes of sizes up to ``box`` (0: points), some of them
    outside of the image and of the grid, one voxel each."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    boxes = torch.cat([1.4 * draw(count, 2) - 0.2, box[0] * draw(count, 2)], -1)
    place = torch.tensor([60.0, 60.0, 8.0]) * draw(count, 3) - torch.tensor([5.0, 30.0, 3.0])
    size = box[1] * draw(count, 3)
    matched = match_rois(boxes.numpy(), preset_rois((32, 64), (4, 8, 16, 32), 2.0))
    return SceneTarget(
        classes=torch.randint(1, 9, (count,), generator=generator),
        boxes_cxcywh=boxes,
        boxes3d_camera=torch.cat([-place[:, 1:2], -place[:, 2:], place[:, :1], size], -1),
        boxes3d_grid=torch.cat([place, size], -1),
        voxels=(draw(count, 3) * torch.tensor([256, 256, 32])).to(torch.int16),
        voxel_object=torch.arange(count),
        visible_fraction=torch.ones(count),
        roi_indices=torch.from_numpy(matched),
    )


def batch_of(contents: list[str], targets: list[SceneTarget]) -> SceneBatch:
    batch = small_batch(len(targets), objects=False)
    camera = dataclasses.replace(batch.camera, image_size=(32, 64))
    for frame, name in enumerate(contents):
        batch.labels[frame] = CONTENTS[name]
    return dataclasses.replace(
        batch, images=batch.images[:, :, :32, :64].contiguous(), camera=camera, targets=targets
    )


def losses_of(module, batch: SceneBatch) -> dict[str, float]:
    """All terms, after a check that they and all gradients are finite and there."""
    module.zero_grad()
    losses = module.losses(batch)
    torch.stack(list(losses.values())).sum().backward()
    values = {name: value.item() for name, value in losses.items()}
    assert all(0 <= value < float("inf") for value in values.values()), values
    for name, parameter in module.named_parameters():
        if parameter.requires_grad:
            assert parameter.grad is not None, name
            assert torch.isfinite(parameter.grad).all(), name
    return values


#: None, fewer than slots, more than queries, more than tokens.
COUNTS = (0, 1, 3, 30, 1000)


@pytest.mark.parametrize("stage", ["pretrain", "full"])
@few
@given(
    st.sampled_from(COUNTS),
    st.sampled_from(COUNTS),
    st.sampled_from(list(CONTENTS)),
    st.sampled_from([(0.0, 0.0), (1.5, 60.0)]),
)
def test_losses_and_gradients_are_finite_whatever_the_frames_hold(
    stage, first, second, content, box
) -> None:
    targets = [objects(first, box), objects(second, box, seed=1)]
    losses = losses_of(stage_of(stage), batch_of([content, "all empty"], targets))
    assert all(map(math.isfinite, losses.values()))


@pytest.mark.parametrize("content", CONTENTS)
def test_each_content_with_a_thousand_objects(content) -> None:
    losses = losses_of(stage_of("full"), batch_of([content], [objects(1000, (0.3, 5.0))]))
    assert all(map(math.isfinite, losses.values()))


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_losses_do_not_depend_on_the_order_of_objects_and_frames(stage) -> None:
    module, targets = stage_of(stage), [objects(5, (0.3, 4.0)), objects(2, (0.3, 4.0), seed=1)]
    batch = batch_of(["all full", "all empty"], targets)
    expected = losses_of(module, batch)
    order, place = torch.randperm(5, generator=torch.Generator().manual_seed(0)), [1, 0]
    fields = dataclasses.fields(SceneTarget)
    shuffled = SceneTarget(**{f.name: getattr(targets[0], f.name)[order] for f in fields})
    shuffled.voxel_object = torch.arange(5)
    matrices = batch.camera.projection[place], batch.camera.lidar_to_camera[place]
    turned = dataclasses.replace(
        batch,
        images=batch.images[place],
        labels=batch.labels[place],
        targets=[targets[1], shuffled],
        camera=dataclasses.replace(
            batch.camera, projection=matrices[0], lidar_to_camera=matrices[1]
        ),
    )
    assert losses_of(module, turned) == pytest.approx(expected, rel=1e-3, abs=1e-5)


@quick
@given(
    st.integers(0, 3),
    st.sampled_from([0.0, 1e-6, 0.3, 60.0]),
    st.sampled_from([-30.0, 0.0, 30.0]),
    st.sampled_from(["trilinear", "nearest"]),
)
def test_fused_grids_hold_known_classes(slots, size, logit, interpolation) -> None:
    fusion = Fusion([9, 13], 0.35, 0.35, 0.2, interpolation)
    boxes = torch.cat([30 * torch.rand(1, slots, 3), torch.full((1, slots, 3), size)], -1)
    found = Slots(
        torch.zeros(1, slots, dtype=torch.long),
        torch.rand(1, slots),
        torch.full((1, slots), 4),
        boxes,
        torch.ones(1, slots, dtype=torch.bool),
    )
    places = torch.tensor([[[0, 0, 0], [255, 255, 31]]])
    voxels = BackgroundLevel(places, torch.full((1, 2), logit), 1)
    logits = torch.full((1, slots, 4, 4, 4), logit)
    grid = fusion(OccupancyOutput(found, logits, [], voxels, torch.randn(1, 2, 2)))
    assert set(grid.unique().tolist()) <= {0, 4, 9, 13}
    if logit < 0:
        assert not grid.any()
    else:
        assert grid[0, 255, 255, 31] in (4, 9, 13) or logit == 0


@quick
@given(st.sampled_from(list(CONTENTS)), st.integers(0, 19))
def test_completion_of_uniform_grids(content, predicted) -> None:
    metric = SemanticSceneCompletion()
    truth = torch.full((1, 256, 256, 32), CONTENTS[content], dtype=torch.uint8)
    metric.update(torch.full_like(truth, predicted), truth)
    scores = metric.compute()
    numbers = [scores[key] for key in ("mIoU", "mIoU_present", "IoU", "precision", "recall")]
    assert all(0 <= number <= 1 for number in numbers)
    known = CONTENTS[content] != 255
    assert scores["IoU"] == (known and predicted > 0 and CONTENTS[content] > 0)


@quick
@given(st.integers(0, 40), st.integers(0, 40), st.sampled_from([0.0, 0.4]), st.integers(0, 9))
def test_detection_scores_of_any_boxes(detections, count, side, seed) -> None:
    generator = torch.Generator().manual_seed(seed)
    target = objects(count, (side, 10 * side), seed)
    metric = DetectionMetric((32, 64))
    metric.update(
        torch.tensor([0]),
        torch.rand(1, detections, generator=generator),
        torch.randint(1, 9, (1, detections), generator=generator),
        torch.rand(1, detections, 4, generator=generator) - 0.5,  # some are inverted
        10 * torch.rand(1, detections, 6, generator=generator),
        [target],
    )
    assert all(0 <= value <= 1 for value in metric.compute().values())
