"""Curves over steps and over training frames."""

from occdetr.study.tables import mean_curve


def test_frames_are_counted_with_the_batch_size_of_each_stage():
    stages = {"pretrain": {"steps": 30, "batch_size": 2}, "full": {"steps": 20, "batch_size": 1}}
    points = [{"step": 15, "AP50": 0.1}, {"step": 30, "AP50": 0.2}, {"step": 50, "AP50": 0.3}]
    records = {0: {"stages": stages, "curve": points}}
    assert mean_curve(records, "AP50") == {15: [0.1], 30: [0.2], 50: [0.3]}
    assert mean_curve(records, "AP50", frames=True) == {30: [0.1], 60: [0.2], 80: [0.3]}
