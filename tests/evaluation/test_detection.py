"""COCO mAP against a slow implementation from its definition."""

import doctest

import numpy as np
import pytest
import torch

from metric_factory import as_xyxy, random_frame, update
from occdetr.evaluation import detection
from occdetr.evaluation.detection import DetectionMetric
from occdetr.structures import empty_target


def iou_2d(a, b):
    inner = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    both = np.prod(np.maximum(inner, 0))
    return both / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - both)


def reference_ap(frames, category, threshold):
    """COCO's interpolated AP of one class, by loops; None for a class without objects."""
    hits, total = [], 0
    for index in frames:
        scores_, classes, boxes, _, target = random_frame(index)
        truth = as_xyxy(target.boxes_cxcywh)[target.classes == category].double().numpy()
        free = [True] * len(truth)
        total += len(truth)
        for i in torch.argsort(-scores_).tolist():
            if classes[i] != category:
                continue
            best, chosen = threshold, None
            for j, box in enumerate(truth):
                overlap = iou_2d(boxes[i].double().numpy(), box)
                if free[j] and overlap >= best:
                    best, chosen = overlap, j
            if chosen is not None:
                free[chosen] = False
            hits.append((float(scores_[i]), chosen is not None))
    if not total:
        return None
    found = np.array([hit for _, hit in sorted(hits, key=lambda pair: -pair[0])], dtype=float)
    recall = np.cumsum(found) / total
    precision = np.cumsum(found) / np.arange(1, len(found) + 1)
    points = np.linspace(0, 1, 101)
    return np.mean([max(precision[recall >= point - 1e-12], default=0.0) for point in points])


def test_average_precision_equals_the_reference():
    frames = list(range(12))
    metric = DetectionMetric(image_size=(370, 1220))
    update(metric, frames[:5])
    update(metric, frames[5:])
    found = metric.compute()
    by_threshold = [
        np.mean([ap for c in range(1, 5) if (ap := reference_ap(frames, c, t)) is not None])
        for t in np.linspace(0.5, 0.95, 10)
    ]
    assert 0.2 < by_threshold[0] < 1
    assert found["AP50"] == pytest.approx(by_threshold[0], abs=1e-9)
    assert found["mAP"] == pytest.approx(np.mean(by_threshold), abs=1e-9)


def test_perfect_detections_score_one():
    target = random_frame(4)[4]
    metric = DetectionMetric()
    metric.update(
        torch.tensor([0]),
        torch.full((1, 4), 0.9),
        target.classes[None],
        as_xyxy(target.boxes_cxcywh)[None],
        target.boxes3d_camera[None],
        [target],
    )
    assert metric.compute() == {"mAP": 1.0, "AP50": 1.0, "recall3d_25": 1.0}


def test_detections_in_frames_without_objects_are_false_positives():
    def ap50(*extra):
        metric = DetectionMetric()
        update(metric, [4, *extra])
        return metric.compute()["AP50"]

    assert ap50(0, 5, 10) < ap50()  # seeds 0, 5, 10: no objects


def test_scores_without_objects_or_detections_are_zero():
    zeros = {"mAP": 0.0, "AP50": 0.0, "recall3d_25": 0.0}
    metric = DetectionMetric()
    update(metric, [0, 5])
    assert metric.compute() == zeros
    nothing = (torch.zeros(1, 0), torch.zeros(1, 0, dtype=torch.long))
    boxes = (torch.zeros(1, 0, 4), torch.zeros(1, 0, 6))
    metric = DetectionMetric()
    metric.update(torch.tensor([0]), *nothing, *boxes, [random_frame(3)[4]])
    assert metric.compute() == zeros
    metric = DetectionMetric()
    metric.update(torch.tensor([0]), *nothing, *boxes, [empty_target()])
    assert metric.compute() == zeros


def test_a_frame_passed_twice_counts_once():
    once, twice = DetectionMetric(), DetectionMetric()
    update(once, [3, 4, 7])
    update(twice, [3, 4])
    update(twice, [7, 3])
    assert twice.compute() == once.compute()


def test_the_example_in_the_docstring():
    assert doctest.testmod(detection).attempted > 0
    assert doctest.testmod(detection).failed == 0
