"""The switches of docs/paper.md have the effects that its table describes."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from model_factory import camera, small_batch, tiny_model
from occdetr.geometry.camera import Camera
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.models.encoder import DeformableEncoder
from occdetr.models.layers import AttentionSize
from occdetr.models.mask_head import MaskHead
from occdetr.models.object_writer import write_objects
from occdetr.models.occupancy_queries import ObjectQueries
from occdetr.models.resnet import ResNet
from occdetr.models.slots import SlotSelection
from occdetr.structures import DetectorOutput, LayerDetections, Proposals

SIZE = AttentionSize(hidden_dim=32, num_heads=4, num_levels=2, num_points=2, feedforward_dim=16)


def detections(scores: list[float], boxes3d: Tensor) -> DetectorOutput:
    """Objects of one class, with these scores."""
    logits = torch.tensor(scores).logit()[None, :, None]
    number = len(scores)
    layer = LayerDetections(logits, torch.full((1, number, 4), 0.5), boxes3d[None])
    proposals = Proposals(torch.zeros(1, number, 1), torch.zeros(1, number, 4))
    return DetectorOutput(torch.zeros(1, number, 8), [layer], proposals, torch.arange(number)[None])


def test_preset_rois_are_the_reference_boxes() -> None:
    model = tiny_model(overrides=("model.detector.selection.position=preset",))
    selection, batch = model.detector.selection, small_batch(1)
    assert not [name for name, _ in selection.named_parameters() if "box_head" in name]
    proposals, selected, _, reference = selection(model.encode(batch.images))
    assert torch.equal(reference[0], selection.rois[selected[0]])
    assert torch.equal(proposals.pred_boxes[0], selection.rois)
    assert not proposals.refined


@pytest.mark.parametrize(("first", "expected"), [(True, [3, 0, 1]), (False, [0, 1, 2])])
def test_matched_queries_take_slots_only_if_they_come_first(first, expected) -> None:
    found = detections([0.9, 0.5, 0.4, 0.01], torch.ones(4, 6))
    slots = SlotSelection(num_slots=3, matched_first=first).select(
        found, torch.tensor([7]), camera(1), torch.tensor([[False, False, False, True]])
    )
    assert slots.query_indices.tolist() == [expected]
    assert slots.used.all()


def test_boxes_keep_their_size_only_along_axes() -> None:
    turn = torch.eye(4)[None]
    c, s = 3**0.5 / 2, 0.5
    turn[0, :3, :3] = torch.tensor([[s, -c, 0.0], [0, 0, -1], [c, s, 0]])  # yawed by 30 degrees
    view = Camera(camera(1).projection, turn, (128, 416))
    found = detections([0.9], torch.tensor([[1.0, 0.5, 12.0, 1.8, 1.6, 4.0]]))
    settings = SlotSelection(num_slots=1, min_box_size=0.0)
    axes = dataclasses.replace(settings, box_transform="axes")
    classes = torch.tensor([1])
    exact, bounds = (each.select(found, classes, view).boxes3d[0, 0] for each in (axes, settings))
    assert torch.allclose(exact[3:], 1.5 * torch.tensor([4.0, 1.8, 1.6]))
    assert torch.allclose(exact[:3], bounds[:3], atol=1e-5)
    assert bounds[4] > 1.5 * exact[4]


def test_boxes_have_a_smallest_size_only_by_default() -> None:
    pole = torch.tensor([[9.0, 0.0, 0.0, 0.2, 0.2, 3.0]])
    assert SlotSelection(num_slots=1).enlarge(pole)[0, 3:].tolist() == pytest.approx(
        [1.6, 1.6, 4.5]
    )
    paper = SlotSelection(num_slots=1, min_box_size=0.0)
    assert paper.enlarge(pole)[0, 3:].tolist() == pytest.approx([0.3, 0.3, 4.5])


@pytest.mark.parametrize("used", [True, False])
def test_class_scores_enter_the_query_only_if_asked(used: bool) -> None:
    switch = f"model.occupancy_decoder.objects.class_scores={used}"
    model, batch = tiny_model(overrides=(switch,)).eval(), small_batch(1)
    memory = model.encode(batch.images)
    logits = []
    for scores in (torch.zeros(1, 2, 10), torch.ones(1, 2, 10)):
        boxes = batch.targets[0].boxes3d_grid[None]
        objects = ObjectQueries(torch.ones(1, 2, 96), scores, boxes, torch.ones(1, 2) > 0)
        with torch.no_grad():
            logits.append(model.occupancy_decoder(objects, memory, batch.camera)[0])
    assert torch.equal(*logits) != used


def test_every_mask_layer_gives_logits_in_training() -> None:
    torch.manual_seed(0)
    head = MaskHead(range(5), SIZE, num_layers=3, voxel_dim=8, auxiliary=True)
    features, embedding = torch.randn(1, 20, 32), torch.randn(1, 30, 8)
    training = head.train()(features, embedding)
    evaluation = head.eval()(features, embedding)
    assert (len(training), len(evaluation)) == (3, 1)
    assert torch.equal(training[-1], evaluation[-1])
    assert not torch.equal(training[0], training[-1])
    head.auxiliary = False
    assert len(head.train()(features, embedding)) == 1


def test_nearest_cells_are_boxes_in_the_grid() -> None:
    cells = torch.rand(1, 4, 4, 4, generator=torch.Generator().manual_seed(0))
    box = torch.tensor([[10.3, 1.1, 0.25, 5.0, 3.0, 2.2]])
    empty = torch.zeros(1, *GRID_SHAPE, dtype=torch.uint8)
    logits, classes = (cells - 0.5)[None], torch.tensor([[7]])
    written = torch.ones(1, 1, dtype=torch.bool)
    found = write_objects(empty, logits, box[None], classes, written, 0.5, "nearest")[0]
    lower = box[0, :3] - box[0, 3:] / 2
    places = torch.tensor([[50, 130, 11], [44, 125, 8], [60, 139, 15], [39, 130, 11]])
    centers = torch.tensor(GRID_ORIGIN) + (places + 0.5) * VOXEL_SIZE
    index = ((centers - lower) / box[0, 3:] * 4).floor().long()
    for place, cell in zip(places.tolist(), index.tolist(), strict=True):
        inside = all(0 <= i < 4 for i in cell)
        assert found[tuple(place)] == (7 if inside and cells[0][tuple(cell)] > 0.5 else 0)
    full = write_objects(empty, logits + 1, box[None], classes, written, 0.5, "nearest")
    assert (full > 0).sum() == 25 * 15 * 11


def test_no_dropout_draws_no_random_number() -> None:
    torch.manual_seed(0)
    model, batch = tiny_model(), small_batch(1)
    model.train()
    before = torch.get_rng_state()
    model(batch.images, batch.camera)
    assert torch.equal(torch.get_rng_state(), before)


def test_dropout_is_for_training() -> None:
    torch.manual_seed(0)
    encoder = DeformableEncoder([4, 4], SIZE, num_layers=1, dropout=0.1)
    features = [torch.randn(1, 4, 6, 8), torch.randn(1, 4, 3, 4)]
    first, second = (encoder.train()(features).tokens for _ in range(2))
    assert not torch.equal(first, second)
    first, second = (encoder.eval()(features).tokens for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize("updated", [True, False])
def test_the_position_encoding_follows_the_boxes_only_if_asked(updated: bool) -> None:
    model = tiny_model(overrides=(f"model.detector.update_position={updated}",)).eval()
    batch, positions = small_batch(1), []
    for head in model.detector.box_heads:
        torch.nn.init.constant_(head[-1].bias, 0.3)  # else the boxes stay where they are
    for layer in model.detector.layers:
        layer.register_forward_hook(lambda _, args, __: positions.append(args[1]))
    with torch.no_grad():
        model.detect(model.encode(batch.images), batch.camera)
    assert len(positions) == 3
    assert torch.equal(positions[0], positions[-1]) != updated


def test_a_fixed_stem_does_not_learn() -> None:
    trunk = ResNet(18, freeze_norm=True, freeze_stem=True)
    learning = {n.split(".")[0] for n, p in trunk.named_parameters() if p.requires_grad}
    assert learning == {"layer2", "layer3", "layer4"}
