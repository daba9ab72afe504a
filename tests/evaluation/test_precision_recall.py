"""Curves of precision by recall, against COCO's evaluation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from metric_factory import random_frame
from occdetr.classes import CLASS_NAMES
from occdetr.evaluation.detection import DetectionMetric
from occdetr.evaluation.precision_recall import (
    OVERALL,
    THRESHOLDS,
    PrecisionRecall,
    precision_recall_curves,
)


@pytest.fixture
def metric() -> DetectionMetric:
    """20 frames, whose scores are all different and lie between two thresholds each."""
    metric = DetectionMetric()
    scores = np.random.default_rng(0).permutation(20 * 12) / 240
    for index, own in enumerate(np.split(scores, 20)):
        _, classes, boxes, boxes3d, target = random_frame(index)
        rows = (torch.from_numpy(own).float(), classes, boxes, boxes3d)
        metric.update(torch.tensor([index]), *(row[None] for row in rows), [target])
    return metric


def average_precision(curve: PrecisionRecall) -> float:
    """COCO's: the mean, over 101 recalls, of the best precision at no smaller recall."""
    used = curve.true_positives + curve.false_positives > 0
    best = np.maximum.accumulate(curve.precision[used])  # thresholds rise, so that recall falls
    levels = np.linspace(0, 1, 101)
    reached = [np.flatnonzero(curve.recall[used] >= level) for level in levels]
    return float(np.mean([best[places[-1]] if len(places) else 0.0 for places in reached]))


def test_the_curves_of_the_classes_give_ap50(metric, monkeypatch) -> None:
    fine = np.linspace(0, 1, 100001)  # every score has a threshold of its own
    monkeypatch.setattr("occdetr.evaluation.precision_recall.THRESHOLDS", fine)
    scores = metric.compute()
    curves = precision_recall_curves(metric.boxes.values())
    by_class = [average_precision(curve) for name, curve in curves.items() if name != OVERALL]
    assert len(by_class) == 3
    assert np.mean(by_class) == pytest.approx(scores["AP50"], abs=1e-6)
    assert 0.05 < scores["AP50"] < 0.95


def test_the_curve_of_all_counts_every_detection_and_object(metric) -> None:
    metric.compute()
    curves = precision_recall_curves(metric.boxes.values())
    whole = curves.pop(OVERALL)
    assert set(curves) <= set(CLASS_NAMES[1:])
    assert whole.true_positives[0] + whole.false_positives[0] == 20 * 12
    assert whole.objects == sum(curve.objects for curve in curves.values()) == 40
    for name in ("true_positives", "false_negatives"):
        parts = sum(getattr(curve, name) for curve in curves.values())
        np.testing.assert_array_equal(getattr(whole, name), parts)
    assert len(whole.recall) == len(THRESHOLDS)
    assert (np.diff(whole.recall) <= 0).all()
    assert whole.recall[-1] == 0


def test_there_is_no_curve_without_objects() -> None:
    assert precision_recall_curves([]) == {}
    nothing = (np.ones((3, 12), np.float32), np.ones((0, 11), np.float32))
    assert precision_recall_curves([nothing]) == {}


def test_reset_forgets_the_boxes(metric) -> None:
    metric.compute()
    assert len(metric.boxes) == 20
    metric.reset()
    assert metric.boxes == {}
