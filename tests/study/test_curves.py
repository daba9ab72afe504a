"""Plots: what their x axis counts."""

from occdetr.study.curves import draw_curves


def test_arms_with_different_batch_sizes_are_plotted_over_frames():
    def drawn(*batches):
        curve = [{"step": step, "mIoU": 0.1} for step in (20, 40)]
        stages = [{"full": {"steps": 40, "batch_size": batch}} for batch in batches]
        arms = [{0: {"curve": curve, "stages": own}} for own in stages]
        return draw_curves({"one": arms[0], "other": arms[1]}, ["mIoU"], "title")

    assert drawn(1, 1) == drawn(2, 2)  # over steps: the batch size does not matter
    assert drawn(2, 1) != drawn(2, 2)
