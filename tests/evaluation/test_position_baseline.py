"""The position baseline against direct counts."""

import numpy as np
import torch

from metric_factory import SMALL, random_grids
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.position_baseline import PositionBaseline, score_baseline
from scene_factory import street, write_dataset


def test_prediction_is_the_most_frequent_class_of_each_position():
    votes = np.array(
        [[1, 1, 2], [0, 5, 5], [9, 4, 255], [255, 255, 255], [255, 255, 19], [0, 0, 7]],
        dtype=np.uint8,
    )
    baseline = PositionBaseline(grid_shape=(6, 1, 1))
    assert not baseline.predict().any()
    for frame in votes.T:
        baseline.update(frame.reshape(6, 1, 1))
    prediction = baseline.predict()
    assert prediction.dtype == np.uint8
    assert prediction.ravel().tolist() == [1, 5, 4, 0, 19, 0]
    assert baseline.num_frames == 3


def test_counts_equal_a_direct_count():
    grids = random_grids(5, frames=7)[1]
    baseline = PositionBaseline(grid_shape=SMALL)
    for grid in grids:
        baseline.update(grid)
    counts = (grids[None] == np.arange(20).reshape(20, 1, 1, 1, 1)).sum(axis=1)
    np.testing.assert_array_equal(baseline.counts, counts)
    np.testing.assert_array_equal(baseline.predict(), counts.argmax(axis=0))


def test_scores_are_those_of_the_training_frames_on_the_held_out_ones(tmp_path):
    """Of three training frames, two have the car where the first held-out frame has it."""
    frames = write_dataset(tmp_path, num_frames=3)
    found = score_baseline([frames[0], frames[0], frames[2]], frames[:2])
    metric = SemanticSceneCompletion()
    prediction = torch.from_numpy(street())[None]
    for shift in (0.0, 2.0):
        metric.update(prediction, torch.from_numpy(street(shift))[None])
    assert found == metric.compute()
    assert 0 < found["per_class"]["car"] < 1
