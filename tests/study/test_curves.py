"""Plots: what their x axis counts."""

from occdetr.study.curves import draw_curves


def test_a_stage_before_does_not_shift_the_curve():
    def arm(before, score=0.1):
        stages = {"pretrain": {"steps": before}} if before else {}
        points = [{"stage": "full", "step": before + step, "mIoU": score} for step in (20, 40)]
        return {0: {"curve": points, "stages": {**stages, "full": {"steps": 40}}}}

    def drawn(one, other):
        return draw_curves({"one": one, "other": other}, ["mIoU"], "title")

    assert drawn(arm(0), arm(100)) == drawn(arm(0), arm(0))
    assert drawn(arm(0), arm(100, score=0.2)) != drawn(arm(0), arm(100))
