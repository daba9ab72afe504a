"""The demonstration: every entry point after another."""

import re

import pytest

from occdetr import demo
from occdetr.cli import entry as cli
from occdetr.cli.overrides import refuse_overrides
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
        ("overrides=['data=synthetic']", "overrides: data=synthetic: the demo has data="),
        ("overrides=['data=synthetic']", "give its settings, as in data.num_train=240"),
        ("overrides=['experiment=release']", "the demo trains experiment=demo"),
        ("overrides=['stage=full']", "overrides: stage=full: the demo trains both stages"),
        ("overrides=['init_from=tiny']", "overrides: init_from=tiny: the demo trains both"),
        ("overrides=['resume=auto']", "overrides: resume=auto: the demo trains both stages"),
        ("overrides=['partition=paper']", "objects of different classes: leave it out"),
        ("overrides=['hydra.run.dir=x']", "give folder= beside overrides"),
        ("data=synthetic", "data: this command has no such group: leave it out"),
    ],
)
def test_a_wrong_setting_is_reported_before_anything_is_made(
    override, expected, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("occdetr.demo.run_entry_point", None)
    assert program("demo", f"folder={tmp_path / 'demo'}", override) == 2
    assert expected in the_error(capsys)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ((), ("data/synthetic-demo", 120)),
        (("overrides=['data.num_train=240','data.root=there']",), ("there", 240)),
        (("overrides=['++data.num_train=240','data={root: there}']",), ("there", 240)),
        (("overrides=['seed=5','model=small','data.flip=0.0']",), ("data/synthetic-demo", 120)),
    ],
)
def test_all_parts_have_the_same_data(settings, expected):
    config = cli.compose("demo", settings)
    refuse_overrides(config.overrides, demo.DECIDED)
    given = {
        "prepare": demo.data_overrides(config),
        "train": ["stage=full", *demo.training_overrides(config)],
        "evaluate": ["checkpoint=tiny", *demo.data_overrides(config)],
    }
    for entry, overrides in given.items():
        data = cli.compose(entry, overrides).data
        assert (data.root, data.num_train) == expected, entry


def test_the_time_of_each_part_is_printed(capsys):
    print_seconds(dict.fromkeys(PARTS, 0.0) | {"full": 30.0, "labels": 10.0})
    printed = capsys.readouterr().out
    assert all(name in printed for name in PARTS.values())
    assert re.search(r"full training\W+30\.0\W+75%", printed)
    assert re.search(r"object labels\W+10\.0\W+25%", printed)
