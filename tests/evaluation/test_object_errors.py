"""Objects and voxels by outcome, and the matching of detections to objects."""

from __future__ import annotations

import pytest
import torch

from model_factory import small_batch
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.diagnosis import Diagnosis
from occdetr.evaluation.object_errors import Written, match_objects
from occdetr.geometry.boxes import enlarge_boxes3d
from planted_errors import (
    CAR,
    ROAD,
    TRUCK,
    call_the_car_a_truck,
    dig_a_hole,
    halve_the_car,
    invent_a_person,
    miss_the_car,
    perfect,
    shift_the_car,
    strip,
    untrained,
)


@pytest.mark.parametrize(
    ("plant", "outcome"),
    [
        (miss_the_car, "missed"),
        (call_the_car_a_truck, "wrong class"),
        (shift_the_car, "wrong place"),
        (halve_the_car, "wrong shape"),
        (dig_a_hole, "right"),
    ],
)
def test_objects_and_their_voxels_by_outcome(plant, outcome, scene) -> None:
    model, criterion, batch, _ = scene
    output = perfect(model, batch)
    plant(output.occupancy)
    diagnosis = Diagnosis(model, criterion)
    diagnosis.update(model, batch, output, model.fusion(output.occupancy))
    results = diagnosis.compute()
    of_car, of_pole = results["objects"]["car"], results["objects"]["pole"]
    assert {key: n for key, n in of_car.items() if n} == {outcome: 2}  # in two frames
    assert {key: n for key, n in of_pole.items() if n} == {"right": 2}
    number = int((batch.labels == CAR).sum())
    lost = {key: n for key, n in results["lost"].get("car", {}).items() if n}
    if outcome in ("missed", "wrong class", "wrong place"):
        assert lost == {outcome: number}
    if outcome == "wrong shape":
        assert 0.3 * number < lost[outcome] < 0.7 * number
    if outcome == "wrong class":
        assert results["invented"]["truck"]["wrong class"] > 0.8 * number
    if outcome == "wrong place":
        assert results["invented"]["car"]["wrong place"] > 0.8 * number


def test_false_detections_and_background_are_distinguished(scene) -> None:
    model, criterion, batch, _ = scene
    output = perfect(model, batch)
    invent_a_person(output.occupancy)
    output.occupancy.mask_logits[:, TRUCK - 1, strip(output.occupancy, ROAD)] = 40.0
    diagnosis = Diagnosis(model, criterion)
    diagnosis.update(model, batch, output, model.fusion(output.occupancy))
    results = diagnosis.compute()
    assert results["objects"]["person"]["false"] == 2
    assert {key for key, n in results["invented"]["person"].items() if n} == {"false"}
    assert {key for key, n in results["invented"]["truck"].items() if n} == {"background"}
    assert results["invented"]["truck"]["background"] == 2 * 4 * 50  # frames, x, y


def test_the_counts_of_wrong_voxels_are_complete() -> None:
    batch = small_batch(2)
    assert batch.labels is not None
    batch.labels[:, 200:204, 10:20, 5] = CAR  # belongs to no object
    model, criterion = untrained("mixed")
    output, grids = model.predict(batch)
    diagnosis, whole = Diagnosis(model, criterion), SemanticSceneCompletion()
    diagnosis.update(model, batch, output, grids)
    whole.update(grids, batch.labels)
    right = whole.confusion.diagonal()
    foreground = model.foreground_classes
    lost = (whole.confusion.sum(0) - right)[foreground]
    invented = (whole.confusion.sum(1) - right)[foreground]
    assert lost.sum() > 0
    assert invented.sum() > 0
    assert torch.equal(diagnosis.errors.lost.sum(1)[foreground], lost)
    assert torch.equal(diagnosis.errors.invented.sum(1)[foreground], invented)
    assert diagnosis.compute()["lost"]["car"]["background"] == 2 * 40
    true_objects = diagnosis.errors.objects[:, :-1].sum()
    assert true_objects == 2 * 2


def match(shift_3d: float, shift_2d: float = 0.0, classes: tuple[int, ...] = (1, 18)) -> list[int]:
    """The objects matched to detections that are shifted in space (y) and in the image (x)."""
    target = small_batch(1).targets[0]
    true_boxes3d = enlarge_boxes3d(target.boxes3d_grid, 1.5, 1.6)
    boxes3d, boxes_cxcywh = true_boxes3d.clone(), target.boxes_cxcywh.clone()
    boxes3d[:, 1] += shift_3d
    boxes_cxcywh[:, 0] += shift_2d
    return match_objects(
        torch.tensor(classes), boxes_cxcywh, boxes3d, target, true_boxes3d
    ).tolist()


def test_objects_match_by_image_boxes_or_by_3d_boxes() -> None:
    assert match(0.0) == [0, 1]
    assert match(5.0) == [0, 1]  # by the image boxes
    assert match(0.5, shift_2d=0.3) == [0, 1]  # by the enlarged 3D boxes
    assert match(5.0, shift_2d=0.3) == [-1, -1]
    assert match(0.0, classes=(4, 6)) == [0, 1]  # classes do not matter


def test_of_two_detections_of_an_object_one_is_false() -> None:
    target = small_batch(1).targets[0]
    true_boxes3d = enlarge_boxes3d(target.boxes3d_grid, 1.5, 1.6)
    classes, first = torch.tensor([TRUCK, CAR]), [0, 0]
    boxes3d, boxes_cxcywh = true_boxes3d[first], target.boxes_cxcywh[first]
    found = match_objects(classes, boxes_cxcywh, boxes3d, target, true_boxes3d)
    assert found.tolist() == [-1, 0]  # the detection of the same class
    written = Written(classes, boxes3d, torch.zeros(2, 1, 1, 1), found)
    assert written.of_objects(2).tolist() == [1, -1]
