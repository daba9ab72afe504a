"""The first surface on each ray: its truth, the head, and what it says of boxes in space."""

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from model_factory import camera, small_batch, tiny_config, tiny_model, tiny_stage
from occdetr.classes import IGNORE
from occdetr.data.augment import flip_calibration
from occdetr.data.semantickitti import Calibration
from occdetr.data.surfaces import first_surfaces
from occdetr.geometry.depths import FARTHEST, NEAREST, depth_position, depth_unit
from occdetr.losses.surface import SurfaceCriterion
from occdetr.models.surface_head import EVIDENCE, STEPS, SurfaceHead, surface_evidence
from occdetr.structures import SurfaceOutput

SIZE = (128, 416)


def calibration():
    projection, lidar_to_camera = (part[0].double().numpy() for part in camera(1))
    return Calibration(projection, lidar_to_camera)


def wall(distance, kind=13):
    """A wall across the whole grid, ``distance`` voxels ahead of its origin."""
    labels = np.zeros((256, 256, 32), dtype=np.uint8)
    labels[distance] = kind
    return labels


def test_a_wall_is_as_far_away_as_it_stands():
    depth, kind = first_surfaces(wall(60), calibration(), SIZE, 4)
    assert depth.shape == kind.shape == (32, 104)
    middle = slice(12, 20), slice(40, 64)
    assert (kind[middle] == 13).all()
    np.testing.assert_allclose(depth[middle], 60 * 0.2 - 0.27, atol=1e-3)


def test_what_is_unknown_or_nowhere_is_told_apart():
    labels = wall(60)
    labels[60, :128] = IGNORE  # the right half, y < 0
    depth, kind = first_surfaces(labels, calibration(), SIZE, 4)
    assert (kind[16, 10:48] == 13).all()
    assert (kind[16, 56:94] == IGNORE).all()
    depth, kind = first_surfaces(np.zeros_like(labels), calibration(), SIZE, 4)
    assert (kind == 0).all()
    assert np.isinf(depth).all()


def test_partial_blocks_are_unknown():
    _, kind = first_surfaces(wall(60), calibration(), (126, 414), 4)
    assert kind.shape == (32, 104)
    assert (kind[-1] == IGNORE).all()
    assert (kind[:, -1] == IGNORE).all()
    assert (kind[14, 40:60] == 13).all()


def test_a_mirrored_frame_has_mirrored_surfaces():
    labels = wall(60)
    labels[30, 100:120] = 1
    depth, kind = first_surfaces(labels, calibration(), SIZE, 4)
    flipped = np.ascontiguousarray(labels[:, ::-1])
    other_depth, other = first_surfaces(flipped, flip_calibration(calibration(), 416), SIZE, 4)
    assert (other[:, ::-1] == kind).mean() > 0.99
    assert (kind == 1).sum() > 20
    np.testing.assert_allclose(np.median(other_depth), np.median(depth), rtol=1e-3)


def test_depths_are_counted_alike_for_every_camera():
    unit = depth_unit(camera(1)[0], SIZE)
    ends = torch.tensor([[NEAREST, FARTHEST]]) * unit
    assert depth_position(ends, unit, 64)[0].tolist() == pytest.approx([0, 64], abs=1e-4)
    twice = camera(1)[0].clone()
    twice[:, 1, 1] *= 2  # twice the focal length: the same picture of something twice as far away
    far = depth_position(torch.tensor([[24.0]]), depth_unit(twice, SIZE), 64)
    near = depth_position(torch.tensor([[12.0]]), unit, 64)
    torch.testing.assert_close(far, near)


def perfect_output(depth, num_depths=64):
    """Logits that are sure of a depth (metres) everywhere."""
    projection = camera(1)[0]
    place = depth_position(torch.tensor([[depth]]), depth_unit(projection, SIZE), num_depths)
    logits = torch.zeros(1, num_depths + 1, 32, 104)
    logits[:, int(place)] = 60.0
    return SurfaceOutput(logits, torch.zeros(1, 19, 32, 104))


def evidence(output, *centers, size=0.4):
    boxes = torch.tensor([[*center, size, size, size] for center in centers])[None]
    return surface_evidence(output, boxes, *camera(1), SIZE)[0]


def test_evidence_tells_before_from_behind():
    output = perfect_output(12.0)
    ahead, at, behind = evidence(output, (6.0, 0, 0), (12.27, 0, 0), (25.0, 0, 0))
    assert ahead.shape == (EVIDENCE,)
    depths = slice(0, 2 * len(STEPS))
    assert ahead[depths].max() < 0.01  # nothing is nearer than this box or a little behind it
    assert behind[depths].min() > 0.99
    torch.testing.assert_close(at[2 * len(STEPS) :], torch.full((19,), 1 / 19))
    front, back = at[: len(STEPS)], at[len(STEPS) : 2 * len(STEPS)]
    assert front[0] < back[0]
    assert front[-1] < 0.01
    assert back[-1] > 0.99
    assert (front.diff() <= 1e-6).all()
    assert (back.diff() >= -1e-6).all()


def test_evidence_is_zero_out_of_view():
    seen = evidence(perfect_output(5.0), (-5.0, 0, 0), (10.0, 20.0, 0), (10.0, 0, 0))
    assert seen[:2].abs().max() == 0
    assert seen[2].max() > 0.9


def test_evidence_is_taken_where_the_box_is_seen():
    output = perfect_output(12.0)
    output.depth_logits[:, :, :, 52:] = perfect_output(40.0).depth_logits[:, :, :, 52:]
    output.class_logits[:, 12, :, :52] = 60.0
    output.class_logits[:, 8, :, 52:] = 60.0
    left, right = evidence(output, (20.0, 3.0, 0), (20.0, -3.0, 0))
    assert left[0] > 0.99
    assert right[0] < 0.01
    classes = slice(2 * len(STEPS), EVIDENCE)
    assert (left[classes].argmax(), right[classes].argmax()) == (12, 8)


def test_the_criterion_counts_what_is_known():
    batch = small_batch(2)
    criterion = SurfaceCriterion(weight_depth=1.0, weight_class=2.0)
    head = SurfaceHead(hidden_dim=16, num_depths=64, num_classes=19)
    output = head(torch.randn(2, 32 * 104, 16), [(32, 104)])
    losses = {name: term.item() for name, term in criterion(output, batch).items()}
    assert set(losses) == {"surface_depth", "surface_class"}
    assert losses["surface_class"] == pytest.approx(2 * np.log(19), rel=0.1)
    assert losses["surface_depth"] == pytest.approx(np.log(65), rel=0.1)
    last = output.depth_logits.shape[1] - 1
    unit = depth_unit(batch.projection, SIZE)
    place = depth_position(batch.surface_depth.nan_to_num(posinf=1e6), unit, last)
    truth = place.floor().clamp(0, last).long()
    sure = 50.0 * torch.nn.functional.one_hot(truth, last + 1).permute(0, 3, 1, 2).float()
    kinds = torch.nn.functional.one_hot((batch.surface_class.long() - 1) % 19, 19)
    right = SurfaceOutput(sure, 50.0 * kinds.permute(0, 3, 1, 2).float())
    assert max(criterion(right, batch).values()) < 1e-3
    batch.surface_class = torch.full_like(batch.surface_class, IGNORE)
    assert max(criterion(output, batch).values()) == 0


@pytest.mark.parametrize("size", ["tiny", "small", "paper"])
def test_the_papers_network_has_none(size):
    config = tiny_config(overrides=[f"model={size}"])
    assert config.model.surface_head is None
    assert "surfaces" not in config.data
    told = tiny_config(overrides=[f"model={size}", "surface=evidence"])
    assert told.model.surface_head.hidden_dim == config.hidden_dim
    assert told.data.surfaces


def test_without_surfaces_nothing_is_said_of_them():
    model = tiny_model()
    assert not [name for name, _ in model.named_parameters() if "surface" in name]
    output, _ = model.predict(small_batch(1))
    assert output.surface is None


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_every_part_of_a_network_with_surfaces_learns(stage):
    module, batch = tiny_stage(stage, overrides=["surface=evidence"]), small_batch(1)
    losses = module.losses(batch) if stage == "full" else None
    if losses is None:
        module.log = module.log_dict = lambda *args, **kwargs: None
        loss = module.training_step(batch, 0)
    else:
        assert {"surface_depth", "surface_class"} <= set(losses)
        loss = sum(losses.values())
    loss.backward()
    without = [
        name
        for name, parameter in module.model.named_parameters()
        if parameter.requires_grad and parameter.grad is None
    ]
    assert not without


def test_surfaces_reach_the_occupancy():
    """The same picture with other surfaces gives another occupancy."""
    model, batch = tiny_model(overrides=["surface=evidence"]), small_batch(1)
    memory, shapes = model.encode(batch.images)
    slots_of = (batch.projection, batch.lidar_to_camera)
    results = []
    for depth in (6.0, 40.0):
        output = model.occupy(None, None, memory, shapes, *slots_of, surface=perfect_output(depth))
        results.append(output.levels[0].logits)
    assert (results[0] - results[1]).abs().max() > 0.01


def test_the_data_module_gives_surfaces_to_networks_that_learn_them(tmp_path):
    streets = ("num_train=1", "num_val=0", "street_image_size=[64,208]", "num_workers=0")
    settings = (f"root={tmp_path}", "batch_size=1", "write_workers=1", *streets)
    config = tiny_config(overrides=["surface=evidence", *(f"data.{text}" for text in settings)])
    data = instantiate(config.data)
    data.prepare_data()
    batch = next(iter(data.train_dataloader()))
    assert batch.surface_depth.shape == batch.surface_class.shape == (1, 32, 104)
    known = batch.surface_class != IGNORE
    assert known.float().mean() > 0.4
    near = batch.surface_depth[known & (batch.surface_class > 0)]
    assert 2 < near.median() < 40
