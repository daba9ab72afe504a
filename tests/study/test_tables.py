"""Scores over steps."""

from occdetr.study.tables import mean_curve


def test_curves_are_of_the_last_stage_and_count_its_steps():
    stages = {"pretrain": {"steps": 30}, "full": {"steps": 20}}
    points = [
        {"stage": "pretrain", "step": 30, "AP50": 0.2},
        {"stage": "full", "step": 40, "AP50": 0.1, "mIoU": 0.3},
        {"stage": "full", "step": 50, "AP50": 0.3, "mIoU": 0.5},
    ]
    both = {"stages": stages, "curve": points}
    alone = {
        "stages": {"full": {"steps": 20}},
        "curve": [{"stage": "full", "step": 20, "mIoU": 0.4}],
    }
    assert mean_curve({0: both}, "mIoU") == {10: [0.3], 20: [0.5]}
    assert mean_curve({0: both}, "AP50") == {10: [0.1], 20: [0.3]}
    assert mean_curve({0: both, 1: alone}, "mIoU") == {20: [0.5, 0.4]}  # what both validated
    assert mean_curve({}, "mIoU") == {}
