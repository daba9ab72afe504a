"""Losses and matching against explicit computations, and frames without objects."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from model_factory import box_target, small_batch, tiny_stage
from occdetr.errors import InputError
from occdetr.geometry.boxes import generalized_box_iou
from occdetr.losses.background import background_bce, state_pyramid
from occdetr.losses.detection import TERMS as DETECTION_TERMS
from occdetr.losses.detection import DetectionCriterion, focal_loss
from occdetr.losses.matcher import HungarianMatcher
from occdetr.losses.occupancy import OccupancyCriterion, dice_loss
from occdetr.losses.targets import ObjectTruth, SceneTruth, object_grid, resample_objects
from occdetr.structures import BackgroundLevel, OccupancyOutput, Slots, empty_target


def test_giou_of_known_boxes() -> None:
    a = torch.tensor([[0.5, 0.5, 1.0, 1.0]])
    b = torch.tensor([[2.5, 0.5, 1.0, 1.0], [0.5, 0.5, 1.0, 1.0], [1.0, 0.5, 1.0, 1.0]])
    expected = torch.tensor([-1 / 3, 1.0, 1 / 3])  # hull 3, union 2; equal; hull = union
    assert torch.allclose(generalized_box_iou(a, b), expected, atol=1e-5)


def test_giou_in_space() -> None:
    a = torch.tensor([[0.0, 0.0, 0.0, 2.0, 2.0, 2.0]])
    b = torch.tensor([[1.0, 0.0, 0.0, 2.0, 2.0, 2.0]])
    assert torch.allclose(generalized_box_iou(a, b), torch.tensor([4 / 12]), atol=1e-5)


def test_matcher_finds_the_cheapest_assignment() -> None:
    """Against every assignment, with costs written out box by box."""
    generator = torch.Generator().manual_seed(0)
    logits = 3 * torch.randn(2, 5, 3, generator=generator)
    predicted = torch.rand(2, 5, 4, generator=generator) * 0.4 + 0.2
    classes = [torch.tensor([0, 2, 2]), torch.zeros(0).long()]
    boxes = [torch.rand(3, 4, generator=generator) * 0.4 + 0.2, torch.zeros(0, 4)]

    def cost(query: int, target: int) -> float:
        p = logits[0, query, classes[0][target]].sigmoid().item()
        focal = 0.25 * (1 - p) ** 2 * -math.log(p) - 0.75 * p**2 * -math.log(1 - p)
        l1 = (predicted[0, query] - boxes[0][target]).abs().sum().item()
        giou = generalized_box_iou(predicted[0, query], boxes[0][target]).item()
        return 2.0 * focal + 5.0 * l1 - 3.0 * giou

    def total(queries: tuple[int, ...]) -> float:
        return sum(cost(query, target) for target, query in enumerate(queries))

    cheapest = min(itertools.permutations(range(5), 3), key=total)
    first, second = HungarianMatcher(2.0, 5.0, 3.0)(
        [logits[:, :2], logits], [predicted[:, :2], predicted], classes, boxes
    )
    assert [len(rows) for rows, _ in first] == [2, 0]  # fewer queries than objects
    (rows, columns), (no_rows, no_columns) = second
    found = dict(zip(columns.tolist(), rows.tolist(), strict=True))
    assert found == dict(enumerate(cheapest))
    assert len(no_rows) == len(no_columns) == 0


@pytest.mark.parametrize("term", ["class", "box"])
def test_matcher_weighs_its_terms(term: str) -> None:
    """Query 0 has the right class, query 1 the right box."""
    box = torch.tensor([[0.5, 0.5, 0.2, 0.2]])
    logits = torch.tensor([[[4.0], [-4.0]]])
    predicted = torch.cat([box + 0.1, box])[None]
    weights = (1.0, 0.0, 0.0) if term == "class" else (0.0, 1.0, 1.0)
    [[(rows, _)]] = HungarianMatcher(*weights)([logits], [predicted], [torch.tensor([0])], [box])
    assert rows.tolist() == [0 if term == "class" else 1]


def test_focal_loss_is_its_formula() -> None:
    logits, truth = torch.tensor([0.3, -1.2]), torch.tensor([1.0, 0.0])
    p = logits.sigmoid()
    expected = torch.stack(
        [-0.25 * (1 - p[0]) ** 2 * p[0].log(), -0.75 * p[1] ** 2 * (1 - p[1]).log()]
    )
    assert torch.allclose(focal_loss(logits, truth), expected)


def test_dice_is_zero_for_the_truth_and_ignores_unknown() -> None:
    truth = torch.tensor([[1.0, 0.0, 1.0, 0.0]])
    logits = (truth - 0.5) * 100
    assert dice_loss(logits, truth, torch.ones(1, 4)).item() < 1e-6
    wrong = logits.clone()
    wrong[0, 3] = 50.0
    assert dice_loss(wrong, truth, torch.ones(1, 4)).item() > 0.1
    assert dice_loss(wrong, truth, torch.tensor([[1.0, 1.0, 1.0, 0.0]])).item() < 1e-6


def test_state_pyramid_carries_unknown() -> None:
    classes = torch.full((1, 4, 4, 2), 255, dtype=torch.uint8)
    classes[0, 0, 0, 0] = 0
    classes[0, 2, 0, 0] = 9
    classes[0, 2, 1, 0] = 0
    pyramid = state_pyramid(classes, {1, 2})
    assert pyramid[2][0, :, :, 0].tolist() == [[1, 0], [2, 0]]
    assert pyramid[1][0, 2, :2, 0].tolist() == [2, 1]
    assert (pyramid[1] == 0).sum() == 29


def test_background_bce_and_unknown_cells() -> None:
    states = torch.tensor([[[[0], [0]], [[2], [0]]]], dtype=torch.uint8)
    coordinates = torch.tensor([[[1, 0, 0], [0, 1, 0]]])
    good = BackgroundLevel(coordinates, torch.tensor([[9.0, 9.0]]), 2)
    bad = BackgroundLevel(coordinates, torch.tensor([[-9.0, 9.0]]), 2)
    assert background_bce(good, states, 0.0).item() < 1e-3
    assert background_bce(bad, states, 0.0).item() > 8
    assert background_bce(good, states, 0.2).item() == pytest.approx(9 * 0.2 / 1.2, abs=1e-2)
    finest = BackgroundLevel(coordinates, torch.tensor([[9.0, 9.0]]), 1)
    assert background_bce(finest, states, 0.2).item() < 1e-3


def small_scene() -> tuple[OccupancyCriterion, OccupancyOutput, torch.Tensor]:
    """Of two roads, a car and a wall the candidates hold one road and the wall, and an unknown
    and an empty voxel; fusion's figures for them: all right."""
    names = ("foreground_dice", "background_bce", "mask_focal", "mask_dice")
    weights = {**dict.fromkeys(names, 1.0), "scene_dice": 3.0}
    criterion = OccupancyCriterion([9, 13], [1], "unclaimed", weights)
    labels = torch.zeros(1, 256, 256, 32, dtype=torch.uint8)
    labels[0, :5, 0, 0] = torch.tensor([9, 9, 1, 13, 255])
    places = torch.tensor([[[0, 0, 0], [3, 0, 0], [4, 0, 0], [5, 0, 0]]])
    voxels = BackgroundLevel(places, torch.tensor([[30.0, 30.0, 30.0, -30.0]]), 1)
    masks = torch.tensor([[[30.0, -30.0, 30.0, 0.0], [-30.0, 30.0, -30.0, 0.0]]])
    return criterion, OccupancyOutput(None, None, [], voxels, masks), labels


def scene_dice(criterion, output, labels) -> torch.Tensor:
    return criterion.mask_losses(output, labels)["scene_dice"] / criterion.weights["scene_dice"]


def test_scene_dice_counts_what_fusion_writes() -> None:
    criterion, output, labels = small_scene()
    road = 1 - (2 * 1 + 1) / (1 + 2 + 1)  # the other road is no candidate
    assert scene_dice(criterion, output, labels).item() == pytest.approx(road / 2)
    output.voxels.logits[0, 1] = -30.0  # the wall stays empty
    wall = 1 - 1 / (0 + 1 + 1)
    assert scene_dice(criterion, output, labels).item() == pytest.approx((road + wall) / 2)


def test_scene_dice_wants_hard_voxels_above_half_their_dice() -> None:
    """100 places where a wall may be, with a chance of 0.2 each: to claim them all is best."""
    criterion, output, labels = small_scene()
    labels[:] = 0
    labels[0, :100:5, 0, 0] = 13
    places = torch.stack([torch.arange(100), torch.zeros(100), torch.zeros(100)], 1).long()
    logits = torch.zeros(1, 100, requires_grad=True)
    output.voxels = BackgroundLevel(places[None], logits, 1)
    output.mask_logits = torch.tensor([-30.0, 30.0])[None, :, None].expand(1, 2, 100)
    scene_dice(criterion, output, labels).backward()
    truth = labels[0, :100, 0, 0] == 13
    together = logits.grad[0, truth].sum() + logits.grad[0, ~truth].sum()
    assert together < 0  # BCE would lower the score of places with a chance of 0.2


def test_affinity_is_that_of_precision_recall_and_specificity() -> None:
    """By class and of the occupancy; voxels that are no candidates count, unknown ones do not."""
    criterion, output, labels = small_scene()
    criterion.weights |= {"sem_scal": 1.0, "geo_scal": 1.0}
    output.voxels.logits[0] = torch.tensor([30.0, 0.0, 30.0, 0.0])
    terms = criterion.mask_losses(output, labels)
    known = 256 * 256 * 32 - 1
    # of two roads one is right; the wall is half there; the empty voxel is half occupied, by either
    road = affinity(hits=1.0, written=1.25, count=2, known=known)
    wall = affinity(hits=0.5, written=0.75, count=1, known=known)
    assert terms["sem_scal"].item() == pytest.approx((road + wall) / 2, rel=1e-5)
    occupied = affinity(hits=1.5, written=2.0, count=4, known=known)
    assert terms["geo_scal"].item() == pytest.approx(occupied, rel=1e-5)


def affinity(hits: float, written: float, count: int, known: int) -> float:
    shares = (hits + 1) / (written + 1), (hits + 1) / (count + 1)
    return -sum(math.log(share) for share in (*shares, 1 - (written - hits) / (known - count + 1)))


def test_objects_are_resampled_where_they_are() -> None:
    target = box_target()
    labels = torch.zeros(256, 256, 32, dtype=torch.uint8)
    owner = object_grid(target)
    objects = torch.tensor([0, 1])
    tight = target.boxes3d_grid
    truth, known = resample_objects(owner, labels, objects, tight, 8)
    assert truth.mean() > 0.9
    assert known.min() == 1
    away = tight + torch.tensor([0.0, 8.0, 0, 0, 0, 0])
    assert resample_objects(owner, labels, objects, away, 8)[0].max() == 0
    wide = torch.cat([tight[:, :3], tight[:, 3:] * 2], -1)
    share = resample_objects(owner, labels, objects[:1], wide[:1], 8)[0].mean()
    assert share == pytest.approx(1 / 8, abs=0.03)


@pytest.mark.parametrize("cells", [8, 5])
def test_linear_object_truth_equals_scipy(cells: int) -> None:
    """Trilinear interpolation at the cells' centres, as the paper scales the ground truth."""
    target = box_target()
    labels = torch.zeros(256, 256, 32, dtype=torch.uint8)
    labels[:, :, 8:] = 255
    owner = object_grid(target)
    boxes = torch.tensor([[12.3, 1.1, -0.9, 6.0, 2.7, 2.4], [9.0, -3.1, 0.1, 1.6, 1.6, 4.5],
                          [50.0, 25.0, 4.0, 6.0, 6.0, 6.0]])  # fmt: skip
    objects = torch.tensor([0, 1, 0])
    found, known = resample_objects(owner, labels, objects, boxes, cells, "linear")
    steps = (np.arange(cells) + 0.5) / cells - 0.5
    for pair, (number, box) in enumerate(zip(objects.tolist(), boxes.numpy(), strict=True)):
        axes = [
            (box[axis] + box[3 + axis] * steps - origin) / 0.2 - 0.5
            for axis, origin in enumerate((0.0, -25.6, -2.0))
        ]
        places = np.stack(np.meshgrid(*axes, indexing="ij"))
        for grid, values in ((owner == number + 1, found), (labels != 255, known)):
            expected = map_coordinates(
                grid.numpy().astype(np.float64), places, order=1, mode="grid-constant"
            )
            np.testing.assert_allclose(values[pair].numpy(), expected.ravel(), atol=1e-4)
    assert found[0].max() > 0.9
    assert found[2].max() == 0


def test_boxes_that_miss_their_object_count_in_the_paper() -> None:
    batch = small_batch(1)
    truth = SceneTruth.of_batch(batch)
    away = truth.targets[0].boxes3d_grid[None] + torch.tensor([0.0, 9.0, 0, 0, 0, 0])
    logits = torch.full((1, 2, 8, 8, 8), 3.0, requires_grad=True)
    query = torch.arange(2)[None]
    slots = Slots(query, torch.ones(1, 2), torch.tensor([[1, 18]]), away, query >= 0)
    output = OccupancyOutput(slots, logits, [], None, None)
    weights = dict.fromkeys(("foreground_dice", "background_bce", "mask_focal", "mask_dice"), 1.0)
    for missed, loss in (("skip", 0.0), ("count", 1.0)):
        criterion = OccupancyCriterion(
            [9], [1, 18], "background", weights, objects=ObjectTruth("linear", missed)
        )
        terms = criterion.foreground_losses(output, truth, [(query[0], torch.arange(2))])
        assert terms["foreground_dice"].item() == pytest.approx(loss, abs=0.01)
    terms["foreground_dice"].backward()
    assert (logits.grad > 0).all()  # to predict nothing is rewarded


def test_earlier_mask_layers_are_supervised_alike() -> None:
    criterion, output, labels = small_scene()
    alone = criterion.mask_losses(output, labels)
    output.aux_mask_logits = [output.mask_logits, output.mask_logits]
    both = criterion.mask_losses(output, labels)
    assert both["aux_mask_focal"].item() == pytest.approx(2 * alone["mask_focal"].item())
    assert both["aux_mask_dice"].item() == pytest.approx(2 * alone["mask_dice"].item())
    assert both["mask_dice"] == alone["mask_dice"]


@pytest.mark.parametrize(
    ("weights", "reason"),
    [
        ({"cls": 1.0, "box2d": 1.0, "giou2d": 1.0, "box3d": 1.0}, "no weight of 'giou3d'"),
        (dict.fromkeys((*DETECTION_TERMS, "boxes"), 1.0), "unknown term 'boxes'"),
    ],
)
def test_weights_must_be_those_of_the_terms(weights: dict[str, float], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        DetectionCriterion(HungarianMatcher(2.0, 5.0, 2.0), [1], weights)


def test_voxels_of_the_background() -> None:
    batch = small_batch(1)
    labels = batch.labels.clone()
    labels[0, 200, 200, 5] = 1  # a car voxel that no object claims
    car = batch.targets[0].voxels[0].long().tolist()
    for choice, claimed, unclaimed in (("unclaimed", 0, 1), ("background", 0, 0), ("all", 1, 1)):
        criterion = tiny_stage(
            "full", overrides=[f"loss.occupancy.background_voxels={choice}"]
        ).occupancy_criterion
        found = criterion.background_classes(SceneTruth.of(labels, batch.targets))
        assert found[0, car[0], car[1], car[2]] == claimed
        assert found[0, 200, 200, 5] == unclaimed
        assert found[0, 10, 120, 1] == 9
        assert found[0, 0, 0, 30] == 255


@pytest.mark.parametrize("objects", [True, False])
def test_pretraining_losses(objects: bool) -> None:
    """Without objects there is no box to regress, and every class score is to fall."""
    module = tiny_stage("pretrain")
    losses = pretraining_losses(module, small_batch(2, objects))
    for name, loss in losses.items():
        if name.endswith("cls") or objects:
            assert 0 < loss < float("inf"), name
        else:
            assert loss == 0, name
    torch.stack(list(losses.values())).sum().backward()
    head = module.model.detector.class_heads[-1]
    assert (head.bias.grad > 0).all() == (not objects)


def pretraining_losses(module, batch) -> dict[str, torch.Tensor]:
    losses = module.losses(batch)
    expected = {
        f"{p}{n}" for p in ("", "aux_") for n in ("cls", "box2d", "giou2d", "box3d", "giou3d")
    }
    expected |= {f"proposal_{n}" for n in ("cls", "box2d", "giou2d")}
    assert set(losses) == expected
    return losses


def test_early_matching_supervises_the_matched_tokens() -> None:
    module = tiny_stage("pretrain")
    batch = small_batch(2)
    output, layers, proposals = module.match(batch)
    for frame, target in enumerate(batch.targets):
        queries, objects = layers[0][frame]
        assert len(objects) == len(target)
        assert torch.equal(output.selected[frame, queries], target.roi_indices[objects])
        assert torch.equal(proposals[frame][0], target.roi_indices)


@pytest.mark.parametrize("partition", ["mixed", "all_foreground", "all_background"])
def test_gradient_reaches_every_parameter(partition: str) -> None:
    module = tiny_stage("full", partition)
    with torch.no_grad():  # layers that start at zero would hide those before them
        for parameter in module.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    batch = small_batch(2)
    for target in batch.targets:  # an object so large that every box, however wrong, meets it
        axes = torch.arange(0, 256, 2), torch.arange(0, 256, 2), torch.arange(0, 32, 2)
        target.voxels = torch.cartesian_prod(*axes).to(torch.int16)
        target.voxel_object = torch.zeros(len(target.voxels), dtype=torch.long)
    losses = module.losses(batch)
    torch.stack(list(losses.values())).sum().backward()
    silent = [
        name
        for name, parameter in module.model.named_parameters()
        if parameter.requires_grad and (parameter.grad is None or parameter.grad.abs().max() == 0)
    ]
    assert silent == []
    if partition == "mixed":
        terms = {"cls", "box2d", "giou2d", "box3d", "giou3d", "foreground_dice"}
        assert terms | {"background_bce", "mask_focal", "mask_dice"} <= set(losses)


@pytest.mark.parametrize("mix", [(False, False), (True, False)])
def test_frames_without_objects_train(mix: tuple[bool, bool]) -> None:
    module = tiny_stage("full")
    batch = small_batch(2)
    batch.targets = [
        t if keep else empty_target() for t, keep in zip(batch.targets, mix, strict=True)
    ]
    losses = module.losses(batch)
    loss = torch.stack(list(losses.values())).sum()
    loss.backward()
    gradients = [p.grad for p in module.model.parameters() if p.requires_grad]
    assert torch.isfinite(loss)
    assert all(g is not None and torch.isfinite(g).all() for g in gradients)


def test_a_box_that_misses_its_object_teaches_no_shape() -> None:
    module = tiny_stage("full")
    batch = small_batch(1)
    model = module.model
    output = model(batch.images, batch.camera).occupancy
    slots = output.slots
    matches = [(slots.query_indices[0, :2], torch.tensor([0, 1]))]
    criterion = module.occupancy_criterion
    given = (output, SceneTruth.of_batch(batch), matches)
    slots.boxes3d[0, :2] = batch.targets[0].boxes3d_grid * torch.tensor([1, 1, 1, 1.5, 1.5, 1.5])
    both = criterion.foreground_losses(*given)
    assert both["foreground_dice"] > 0.5
    assert both["foreground_bce"] > 0
    output.foreground_logits[0, 1] = 100.0  # certain of an object that is not in the box
    slots.boxes3d[0, 1, 0] += 20.0
    one = criterion.foreground_losses(*given)
    slots.boxes3d[0, 0, 0] += 20.0
    none = criterion.foreground_losses(*given)
    assert 0 < one["foreground_dice"] <= 2.0
    assert none["foreground_dice"] == none["foreground_bce"] == 0
