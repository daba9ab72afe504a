"""The demonstration: every entry point after another."""

import re

import pytest

from occdetr.demo import PARTS, print_seconds
from programs import STREETS, program, read_json, subprogram, the_error


@pytest.mark.slow
def test_demo_leaves_figures_and_a_picture(streets, tmp_path):
    few = ("trainer.max_epochs=1", "image_size=[64,208]", f"data.root={streets}", *STREETS)
    overrides = ",".join(f"'{text}'" for text in few)
    done = subprogram("demo", f"folder={tmp_path}", f"overrides=[{overrides}]")
    assert done.returncode == 0, done.stderr
    assert re.search(r"released\W+other images\W+trained here\W+positions", done.stdout)
    metrics = read_json(tmp_path / "metrics.json")
    for name in ("released", "released_exchanged", "trained"):
        scores = {"mIoU", "IoU", "precision", "recall", "per_class", "mAP", "AP50"}
        assert scores <= set(metrics[name])
    assert 0 < metrics["baseline"]["mIoU"] < metrics["baseline"]["IoU"] < 1
    assert "time by part" in done.stdout
    assert list(metrics["seconds"]) == list(PARTS)
    assert min(metrics["seconds"][part] for part in ("pretrain", "full", "evaluate")) > 1
    assert (tmp_path / "prediction.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("overrides=['trainer.max_epoch=1']", "trainer.max_epoch: no such setting"),
        ("released=large", "checkpoint=large: no such file"),
    ],
)
def test_a_wrong_setting_is_reported_before_anything_is_made(
    override, expected, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("occdetr.demo.run_entry_point", None)
    assert program("demo", f"folder={tmp_path / 'demo'}", override) == 2
    assert expected in the_error(capsys)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_the_time_of_each_part_is_printed(capsys):
    print_seconds(dict.fromkeys(PARTS, 0.0) | {"full": 30.0, "labels": 10.0})
    printed = capsys.readouterr().out
    assert all(name in printed for name in PARTS.values())
    assert re.search(r"full training\W+30\.0\W+75%", printed)
    assert re.search(r"object labels\W+10\.0\W+25%", printed)
