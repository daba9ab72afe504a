"""The diagnosis of a prediction that cannot be improved."""

from __future__ import annotations

from occdetr.evaluation.diagnosis import Diagnosis
from planted_errors import perfect


def test_a_perfect_prediction_has_nothing_to_gain(scene) -> None:
    model, criterion, batch, best = scene
    diagnosis = Diagnosis(model, criterion)
    output = perfect(model, batch)
    diagnosis.update(model, batch, output, best.expand(2, -1, -1, -1))
    assert diagnosis.compute()["advice"].startswith("No part alone")
    diagnosis.reset()
    assert diagnosis.errors.objects.sum() == 0
    assert all(int(metric.num_frames) == 0 for metric in diagnosis.completion)
