"""Which objects are found, overall, by class and by distance."""

import pytest
import torch

from metric_factory import boxes_target
from occdetr.evaluation.detection import DetectionMetric
from occdetr.evaluation.distance import BANDS
from occdetr.evaluation.recall import DetectionRecall
from occdetr.geometry.boxes import cxcywh_to_xyxy
from occdetr.structures import SceneTarget


def recall_of(detections, objects, threshold=0.3):
    """3D recall of (score, class, box3d) detections for (class, box3d) objects."""
    target = boxes_target(
        [c for c, _ in objects],
        [[0.5, 0.5, 0.2, 0.2]] * len(objects),
        torch.tensor([box for _, box in objects]),
    )
    metric = DetectionMetric(score_threshold=threshold)
    metric.update(
        torch.tensor([0]),
        torch.tensor([[s for s, _, _ in detections]]),
        torch.tensor([[c for _, c, _ in detections]]),
        torch.zeros(1, len(detections), 4),
        torch.tensor([[box for _, _, box in detections]]),
        [target],
    )
    return metric.compute()["recall3d_25"]


def box_at(x, size=2.0):
    return [float(x), 0.0, 10.0, size, 2.0, 2.0]


def test_recall_3d_by_hand():
    cars = [(1, box_at(0)), (1, box_at(5))]
    assert recall_of([(0.9, 1, box_at(1)), (0.8, 1, box_at(5))], cars) == 1.0  # IoU 1/3 and 1
    assert recall_of([(0.9, 1, box_at(1.3)), (0.8, 1, box_at(5))], cars) == 0.5  # IoU 0.21
    assert recall_of([(0.9, 2, box_at(0)), (0.8, 1, box_at(5))], cars) == 0.5  # another class
    assert recall_of([(0.29, 1, box_at(0)), (0.8, 1, box_at(5))], cars) == 0.5  # score too low
    assert recall_of([(0.29, 1, box_at(0)), (0.8, 1, box_at(5))], cars, threshold=0.2) == 1.0
    assert recall_of([(0.9, 1, box_at(0)), (0.8, 1, box_at(0.1))], cars) == 0.5  # one to one


def test_the_second_detection_takes_the_object_that_is_left():
    near = [(1, box_at(0)), (1, box_at(0.8))]
    assert recall_of([(0.9, 1, box_at(0.1)), (0.8, 1, box_at(0.1))], near) == 1.0


def target_at(distances, classes):
    """Objects of 2 m, ``distances`` metres ahead; in the image side by side, each 0.1 wide."""
    count = len(distances)
    center_x = (torch.arange(count) + 0.5) / 10
    x, ones = torch.tensor(distances, dtype=torch.float32), torch.ones(count)
    return SceneTarget(
        classes=torch.tensor(classes, dtype=torch.long),
        boxes_cxcywh=torch.stack([center_x, 0.5 * ones, 0.1 * ones, 0.2 * ones], 1),
        boxes3d_camera=torch.stack([0 * ones, 0 * ones, x, *[2 * ones] * 3], 1),
        boxes3d_grid=torch.stack([x, 0 * ones, 0 * ones, *[2 * ones] * 3], 1),
        voxels=torch.zeros(0, 3, dtype=torch.int16),
        voxel_object=torch.zeros(0, dtype=torch.long),
        visible_fraction=ones,
        roi_indices=torch.arange(count),
    )


def detect(metric, target, scores, classes=None, shift_2d=0.0, shift_3d=0.0):
    """Detections of all objects, their boxes shifted in the image (x) and in space (depth)."""
    classes = target.classes if classes is None else classes
    boxes_cxcywh, boxes3d = target.boxes_cxcywh.clone(), target.boxes3d_camera.clone()
    boxes_cxcywh[:, 0] += shift_2d
    boxes3d[:, 2] += shift_3d
    metric.update(
        *(torch.tensor([0]), torch.tensor([scores], dtype=torch.float32), classes[None]),
        *(cxcywh_to_xyxy(boxes_cxcywh)[None], boxes3d[None], [target]),
    )


def test_objects_are_counted_by_class_and_band():
    target = target_at([5.0, 12.7, 12.8, 30.0, 31.0], [1, 6, 1, 1, 18])
    metric = DetectionRecall(score_threshold=0.3)
    detect(metric, target, [0.9, 0.2, 0.9, 0.9, 0.9], shift_3d=0.5)  # the second score is too low
    detect(metric, target, [0.9] * 5, shift_2d=0.04, shift_3d=1.3)  # IoU 0.43 and 0.21
    found = metric.compute()
    assert list(found) == ["car", "person", "pole"]
    counts = {name: [tuple(found[name][band].values()) for band in BANDS] for name in found}
    assert counts == {
        "car": [(2, 1, 1), (2, 1, 1), (2, 1, 1)],
        "person": [(2, 0, 0), (0, 0, 0), (0, 0, 0)],
        "pole": [(0, 0, 0), (0, 0, 0), (2, 1, 1)],
    }
    assert metric.counts.dtype == torch.int64


def test_recall_in_2d_and_in_3d_is_independent_and_needs_the_class():
    target = target_at([5.0, 20.0], [1, 6])
    for shifts, classes, expected in (
        ({"shift_2d": 0.04}, None, (0, 1)),
        ({"shift_3d": 1.3}, None, (1, 0)),
        ({}, torch.tensor([1, 7]), (1, 1)),
    ):
        metric = DetectionRecall()
        detect(metric, target, [0.9, 0.9], classes, **shifts)
        found = metric.compute()
        first = found["car"][BANDS[0]]
        assert (first["found2d_50"], first["found3d_25"]) == expected
        person = found["person"][BANDS[1]]
        assert person["found2d_50"] == (0 if classes is not None else expected[0])


@pytest.mark.parametrize("shift_3d", [0.0, 1.1, 1.3])
def test_recall_summed_over_classes_and_bands_is_that_of_the_detection_metric(shift_3d):
    target = target_at([5.0, 20.0, 40.0], [1, 1, 18])
    detection, recall = DetectionMetric(), DetectionRecall()
    for metric in (detection, recall):
        detect(metric, target, [0.9, 0.1, 0.9], shift_3d=shift_3d)
    objects, _, found_3d = recall.counts.sum((1, 2)).tolist()
    assert objects == 3
    assert detection.compute()["recall3d_25"] == pytest.approx(found_3d / objects)


def test_without_objects_nothing_is_counted():
    metric = DetectionRecall()
    target = target_at([], [])
    detect(metric, target, [])
    assert metric.compute() == {}
