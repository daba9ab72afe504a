"""Preparation of object labels before training."""

import shlex

import pytest

from malformed import data_set
from occdetr.cli import entry as cli
from programs import newest, program, read_json, the_error


def settings(streets, tmp_path):
    """Five frames, in a cache of their own."""
    return (
        *("data=semantickitti", f"data.root={streets}", "data.train_sequences=[0,1]"),
        *(f"data.cache_dir={tmp_path / 'cache'}", f"outputs={tmp_path}", "workers=1"),
    )


def test_prepare_caches_every_frame(streets, tmp_path, capsys):
    for built, rebuild in ((5, False), (0, False), (5, True)):
        assert program("prepare", *settings(streets, tmp_path), f"rebuild={rebuild}") == 0
        report = read_json(newest(tmp_path, "prepare/*/prepare.json"))
        assert (report["frames"], report["built"]) == (5, built)
        assert report["frames_per_second"] > 0
        seconds, shown = report["seconds_per_frame"], capsys.readouterr().out
        assert f"5 frames ({built} built, {5 - built} already there)" in shown
        assert ("visibility (ray casting)" in shown) == (built > 0)
        if built:
            assert 0 < seconds["clustering"] < seconds["object_labels"] < 1
        else:
            assert set(seconds.values()) == {None}
    assert len(list((tmp_path / "cache").rglob("*.npz"))) == 5


def test_the_next_command_trains_on_the_same_data(streets, tmp_path, capsys):
    given = settings(streets, tmp_path)
    assert program("prepare", *given, "partition=all_foreground", "shard=1/5") == 0
    words = shlex.split(capsys.readouterr().out.splitlines()[-1].partition("next: ")[2])
    assert words[:4] == ["python", "-m", "occdetr.train", "stage=pretrain"]
    assert words[4:] == [*given[:-1], "partition=all_foreground"]
    trained = cli.build(cli.compose("train", words[3:]).data)
    assert len(trained.frames("train")) == 2
    assert len(trained.labels.settings.classes) == 19


def test_shards_share_the_frames(streets, tmp_path):
    built = []
    for shard in ("1/3", "2/3", "3/3", "6/6", "1/1"):
        assert program("prepare", *settings(streets, tmp_path), f"shard={shard}") == 0
        report = read_json(newest(tmp_path, "prepare/*/prepare.json"))
        built.append((report["frames"], report["built"]))
    assert built == [(2, 2), (2, 2), (1, 1), (0, 0), (5, 0)]


def test_a_partial_data_set_is_prepared_only_if_asked(tmp_path, capfd):
    """Of two frames each in sequence 00 and 08 one lacks its label."""
    given = data_set(lambda sequence: (sequence / "voxels/000005.label").unlink(), tmp_path)
    assert program("prepare", *given, "workers=1") == 2
    assert "00/voxels/000005.label: file is missing" in the_error(capfd)
    with pytest.warns(UserWarning, match=r"000005\.label: file is missing.* 00: 1 of 2") as caught:
        assert program("prepare", *given, "workers=1", "data.allow_partial=true") == 0
    assert len(caught) == 1
    assert read_json(tmp_path / "run/prepare.json")["frames"] == 3
