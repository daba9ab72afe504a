"""Substituting a part of a prediction by the truth corrects the errors of that part alone."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from model_factory import small_batch
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.diagnosis import Diagnosis
from occdetr.evaluation.substitution import PREDICTION_PARTS, SubstitutedFrame, nearest
from occdetr.evaluation.upper_bound import LIMITS, UpperBound
from occdetr.losses.targets import SceneTruth
from occdetr.structures import SceneBatch, empty_target
from planted_errors import CAR, PLANTED, perfect, shift_the_car, untrained


def test_a_perfect_prediction_stays_perfect(scene) -> None:
    model, criterion, batch, best = scene
    output = perfect(model, batch)
    assert torch.equal(model.fusion(output.occupancy), best.expand(2, -1, -1, -1))
    frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, 1)
    for parts in ([], *[[part] for part in PREDICTION_PARTS], PREDICTION_PARTS):
        assert torch.equal(frame.fuse(parts), best), parts


@pytest.mark.parametrize(
    ("plant", "part"), PLANTED.items(), ids=lambda v: getattr(v, "__name__", "")
)
def test_an_error_is_corrected_by_the_truth_of_its_part_only(plant, part, scene) -> None:
    model, criterion, batch, best = scene
    output = perfect(model, batch)
    plant(output.occupancy)
    damaged = model.fusion(output.occupancy)
    frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, 0)
    assert torch.equal(frame.fuse([]), damaged[:1])
    assert not torch.equal(damaged[:1], best)
    assert torch.equal(frame.fuse([part]), best)
    assert torch.equal(frame.fuse(PREDICTION_PARTS), best)
    for other in set(PREDICTION_PARTS) - {part}:
        found = frame.fuse([other])
        if (plant, other) == (shift_the_car, "object occupancy"):
            # the shifted box has no cell of the car: it disappears and is not restored
            assert (found[best == CAR] != CAR).all()
            continue
        assert torch.equal(found, damaged[:1]), other
    diagnosis = Diagnosis(model, criterion)
    diagnosis.update(model, batch, output, damaged)
    results = diagnosis.compute()
    assert results["num_frames"] == 2
    assert results["advice"].startswith(f"Work on the {part}: ")
    together = [scores["mIoU"] for scores in results["together"].values()]
    assert together[-1] == pytest.approx(completion(batch, best))
    assert results["as_predicted"]["mIoU"] < together[-1]


def completion(batch: SceneBatch, best: Tensor) -> float:
    metric = SemanticSceneCompletion()
    assert batch.labels is not None
    metric.update(best.expand(2, -1, -1, -1), batch.labels)
    return metric.compute()["mIoU"]


@pytest.mark.parametrize("partition", ["mixed", "all_foreground", "all_background"])
def test_with_all_parts_true_the_score_is_the_upper_bound(partition: str) -> None:
    batch = small_batch(2, objects=partition != "all_background")
    assert batch.labels is not None
    assert batch.targets is not None
    batch.labels[1, 60:70, 20:30, 5:9] = 255
    model, criterion = untrained(partition)
    output, grids = model.predict(batch)
    bound, diagnosis = UpperBound(model, criterion), Diagnosis(model, criterion)
    truth = SceneTruth.of_batch(batch)
    for index in range(2):
        frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, index)
        assert torch.equal(frame.fuse([])[0], grids[index])
        best = bound.perfect_grid(truth.frame(index), LIMITS)
        assert torch.equal(frame.fuse(diagnosis.parts), best)
    parts = list(PREDICTION_PARTS)
    expected = {"mixed": parts, "all_foreground": parts[:3], "all_background": parts[3:]}
    assert diagnosis.parts == expected[partition]
    bound.update(batch)
    diagnosis.update(model, batch, output, grids)
    results, expected = diagnosis.compute(), bound.results()["all"]
    last = results["together"][diagnosis.parts[-1]]
    assert last == {key: expected[key] for key in last}
    assert bool(results["objects"]) == (partition != "all_background")


def test_a_frame_without_objects() -> None:
    batch = small_batch(2)
    assert batch.targets is not None
    batch.targets[1] = empty_target()
    model, criterion = untrained("mixed")
    output, grids = model.predict(batch)
    frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, 1)
    truth = SceneTruth.of_batch(batch).frame(1)
    best = UpperBound(model, criterion).perfect_grid(truth, LIMITS)
    assert torch.equal(frame.fuse(PREDICTION_PARTS), best)
    diagnosis = Diagnosis(model, criterion)
    diagnosis.update(model, batch, output, grids)
    false = sum(outcomes["false"] for outcomes in diagnosis.compute()["objects"].values())
    assert 5 <= false <= 10  # five slots per frame, at most two of them matched, in the first frame
    model.fusion.score_threshold = 1.0  # no detections either
    grids = model.fusion(output.occupancy)
    frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, 1)
    assert torch.equal(frame.fuse([])[0], grids[1])
    assert torch.equal(frame.fuse(PREDICTION_PARTS), best)


def test_the_nearest_voxel_is_found_where_most_are_at_the_border() -> None:
    """With denormal numbers at zero, as in a run; SciPy's tree has ended the process."""
    rows = torch.cartesian_prod(torch.zeros(1), torch.arange(40.0), torch.arange(40.0))
    far = torch.cartesian_prod(torch.full((1,), 200.0), torch.arange(3.0), torch.arange(3.0))
    voxels = torch.cat([rows, far]).long()
    torch.set_flush_denormal(True)
    try:
        found = nearest(voxels, torch.tensor([[30, 7, 9], [180, 2, 9], [0, 0, 0]]))
    finally:
        torch.set_flush_denormal(False)
    assert voxels[found].tolist() == [[0, 7, 9], [200, 2, 2], [0, 0, 0]]
