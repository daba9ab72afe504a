"""Metrics over two ranks equal those of one."""

from datetime import timedelta

import pytest
import torch
from torch.multiprocessing.spawn import spawn

from metric_factory import random_grids, update
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.detection import DetectionMetric
from occdetr.evaluation.evaluator import SceneEvaluator


def completion_of(frames):
    metric = SemanticSceneCompletion()
    for index in frames:
        metric.update(*(torch.from_numpy(grid) for grid in random_grids(index, frames=1)))
    return metric


def detection_of(frames):
    metric = DetectionMetric()
    for index in frames:
        update(metric, [index])
    return metric


def evaluator_of(frames):
    evaluator = SceneEvaluator((370, 1220), detects=True)
    for index in frames:
        grids = random_grids(index, frames=1)
        evaluator.completion.update(*(torch.from_numpy(grid) for grid in grids))
        for metric in (evaluator.detection, evaluator.recall):
            update(metric, [index])
    return evaluator


#: Frames of each of two ranks: an odd number of them, and a rank without frames.
SHARES = (([3, 5, 9], [4, 7]), ([3, 4, 5, 7, 9], []), ([], [3, 4, 5, 7, 9]))
PADDED = ([3, 5, 9], [4, 7, 3])


def run_rank(rank, folder):
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo",
        init_method=f"file://{folder}/store",
        rank=rank,
        world_size=2,
        timeout=timedelta(seconds=60),  # a deadlock fails instead of hanging
    )
    found = [detection_of(share[rank]).compute() for share in (*SHARES, PADDED)]
    found += [completion_of(share[rank]).compute() for share in SHARES]
    found += [evaluator_of(share[rank]).compute() for share in SHARES]
    torch.save(found, f"{folder}/rank{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.filterwarnings("ignore")
def test_scores_over_two_ranks_equal_those_of_one(tmp_path):
    spawn(run_rank, (str(tmp_path),), nprocs=2)
    frames = [3, 4, 5, 7, 9]
    expected = [detection_of(frames).compute()] * 4 + [completion_of(frames).compute()] * 3
    expected += [evaluator_of(frames).compute()] * 3
    assert expected[-1]["objects_found"]
    for rank in range(2):
        assert torch.load(tmp_path / f"rank{rank}.pt") == expected
