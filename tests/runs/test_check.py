"""The check of a data set by ``prepare check=true``."""

import shlex

import pytest

from malformed import data_set, remove
from occdetr.cli import entry as cli
from programs import program, read_json, the_error
from scene_factory import write_frame


def files(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_a_set_that_can_be_used(tmp_path, capsys):
    given = [*data_set(lambda sequence: None, tmp_path), "data.test_sequences=[]", "workers=1"]
    before = files(tmp_path / "data")
    assert program("prepare", *given, "check=true", "check_whole=1") == 0
    lines = capsys.readouterr().out.splitlines()
    assert files(tmp_path / "data") == before
    rows = [line.split() for line in lines if line.strip().startswith(("00 ", "08 "))]
    numbers = ["2"] * 5
    assert rows == [
        ["00", "train", *numbers, "208x64", "-", "-", "2", "of", "2", "-"],
        ["08", "val", *numbers, "208x64", "-", "-", "2", "of", "2", "-"],
    ]
    words = shlex.split(lines[-1].removeprefix("next: "))
    assert words[:3] == ["python", "-m", "occdetr.prepare"]
    assert not cli.compose("prepare", words[3:]).check
    report = read_json(tmp_path / "run/check.json")
    assert report["usable"]
    assert report["sequences"]["08"]["frames"] == {"complete": 2, "expected": 2}
    assert report["findings"] == []


def test_an_extra_folder_that_is_missing(tmp_path, capsys):
    given = [*data_set(lambda sequence: None, tmp_path), "data.test_sequences=[]", "workers=1"]
    assert program("prepare", *given, "check=true", f"data.extra_roots=[{tmp_path}/none]") == 3
    *_, verdict, step = capsys.readouterr().out.splitlines()
    assert "cannot run" in verdict
    assert step.startswith(f"next: data.extra_roots: there is no folder {tmp_path}/none")
    assert not read_json(tmp_path / "run/check.json")["usable"]


def test_a_set_that_cannot(tmp_path, capsys):
    def damage(sequence):
        for name in ("000000", "000005"):
            remove(f"voxels/{name}.label", sequence)
        (sequence / "image_2/000003.png").touch()

    given = [*data_set(damage, tmp_path), "workers=1"]
    assert program("prepare", *given, "check=true") == 3
    lines = capsys.readouterr().out.splitlines()
    (error,) = [line for line in lines if line.startswith("error: ")]
    assert "sequences/00/voxels/*.label" in error
    notes = [line for line in lines if line.startswith("note: ")]
    assert len(notes) == 2
    assert "(11 in sequences 11-21)" in notes[0]
    assert "sequences/00/image_2/000003.png: image is empty" in notes[1]
    assert lines[-1].startswith("next: unpack data_odometry_voxels.zip from semantic-kitti.org")
    report = read_json(tmp_path / "run/check.json")
    assert not report["usable"]
    assert report["next"] == lines[-1].removeprefix("next: ")
    levels = [finding["level"] for finding in report["findings"]]
    assert (levels.count("error"), levels.count("note")) == (1, 12)


def test_wrong_roots_are_errors_of_the_user(tmp_path, capfd):
    write_frame(tmp_path / "kitti/dataset", "00", "000000")
    given = ("check=true", f"outputs={tmp_path / 'outputs'}")
    assert program("prepare", "data=semantickitti", f"data.root={tmp_path / 'kitti'}", *given) == 2
    assert f"data.root={tmp_path / 'kitti/dataset'}" in the_error(capfd)
    assert program("prepare", f"data.root={tmp_path / 'streets'}", *given) == 2
    assert "run python -m occdetr.prepare" in the_error(capfd)
    assert not (tmp_path / "streets").exists()


@pytest.mark.parametrize(
    ("settings", "unused"),
    [(["check=true", "rebuild=true"], "rebuild=true"), (["check_whole=0"], "check_whole=0")],
)
def test_settings_without_effect_are_refused(settings, unused, tmp_path, capfd):
    place = f"outputs={tmp_path / 'outputs'}"
    assert program("prepare", f"data.root={tmp_path}", place, *settings) == 2
    assert the_error(capfd).startswith(f"error: {unused}: ")
