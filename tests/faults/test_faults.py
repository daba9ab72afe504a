"""The short form of ``make faults``: a training of each stage, killed twice."""

import random

import pytest

from faults.bench import Bench, Training
from faults.cases import Report
from faults.moments import AtRenaming, WhileWriting
from faults.trainings import Chain, ends_by_itself

MOMENTS = (WhileWriting(2, ".ckpt", 0.5), AtRenaming(1, ".ckpt"))


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_killed_training_ends_as_the_undisturbed_one(stage, streets, tmp_path):
    data = ("data.num_train=2", "data.num_val=3", "data.street_image_size=[124,410]")
    bench = Bench(tmp_path, (*data, f"data.root={streets}"), epochs=2)
    moments, report = iter(MOMENTS), Report()
    chain = Chain(Training(stage), 2, ends_by_itself, before=lambda generator: next(moments))
    chain(bench, random.Random(0), tmp_path / "killed", report)
    assert report.lost == []
    assert report.injected == 2
