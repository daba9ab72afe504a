"""The demonstration: every entry point after another."""

import pytest

from programs import STREETS, read_json, subprogram


@pytest.mark.slow
def test_demo_leaves_figures_and_a_picture(streets, tmp_path):
    few = ("trainer.max_epochs=1", "image_size=[64,208]", f"data.root={streets}", *STREETS)
    overrides = ",".join(f"'{text}'" for text in few)
    done = subprogram("demo", f"folder={tmp_path}", f"overrides=[{overrides}]")
    assert done.returncode == 0, done.stderr
    assert "position baseline" in done.stdout
    metrics = read_json(tmp_path / "metrics.json")
    assert {"mIoU", "IoU", "precision", "recall", "per_class", "mAP", "AP50"} <= set(metrics)
    assert 0 < metrics["baseline"]["mIoU"] < metrics["baseline"]["IoU"] < 1
    assert (tmp_path / "prediction.png").stat().st_size > 10_000
