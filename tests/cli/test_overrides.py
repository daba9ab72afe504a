"""Paths on the command line arrive as they were typed."""

from __future__ import annotations

import os
import shlex
from types import SimpleNamespace

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from occdetr.cli import entry as cli
from occdetr.cli.overrides import (
    as_typed,
    changed_settings,
    command_line,
    literal_path,
    literal_paths,
    overrides_of,
    refuse_overrides,
)
from occdetr.cli.subprocesses import run_entry_point
from occdetr.errors import InputError
from programs import program, the_error

TYPED = (
    *("2024", "2024_05_01", "1e5", "-7", "+1.0", "nan", "true", "NULL", "-x", "+x", "--x"),
    *("~/pictures", "Fahrräder/Köln", "街道/照片", "😀", "e\u0301", "a b", " a", "a ", "a\tb"),
    *("a(b)", "(", "a,b", ",", "a=b", "=", "[a]", "[", "{a}", "{a:b}", "}", "a:b", "a;b", "a#b"),
    *("a\nb", "'a", 'a"', "it's", "'", '"', "\\", "a\\", "a\\'b", "C:\\x\\", "$", "$x", "${"),
    *("a${b", "100%", "*.png", "@", "!", "&", "a|b", "<a>", "`", "^", "null.png", "range(3)"),
)


def test_a_path_arrives_as_it_was_typed():
    for typed in TYPED:
        word = literal_path(f"images={typed}")
        assert literal_path(word) == word  # an entry point passes it on to a further rank
        read = OverridesParser.create().parse_override(word)
        assert not read.is_sweep_override()
        assert OmegaConf.create({"images": read.value()}).images == os.path.expanduser(typed)


@pytest.mark.parametrize("typed", ["2024_05_01", "~/ä (1), b=c"])
def test_an_entry_point_gets_it(typed, tmp_path, capsys):
    given = [f"checkpoint={typed}", "images=x", "calib=y", f"hydra.run.dir={tmp_path}/{typed}"]
    assert program("evaluate", given[0], given[-1]) == 2
    assert f"checkpoint={os.path.expanduser(typed)}: no such file" in the_error(capsys)
    config = cli.compose("predict", given)
    assert config.checkpoint == os.path.expanduser(typed)


def test_the_file_of_an_export_arrives_as_it_was_typed():
    given = "output=~/ä (1), b=c.onnx"
    assert cli.compose("export", [given]).output == os.path.expanduser("~/ä (1), b=c.onnx")
    assert cli.compose("export", ["output=2024_05"]).output == "2024_05"


def test_paths_below_a_node_and_new_ones_arrive_too():
    given = ["data.root=2024", "+data.cache_dir=a (b)", "+callbacks.x.dirpath=1", "start=~/1"]
    assert list(map(literal_path, given)) == [
        *("data.root='2024'", "+data.cache_dir='a (b)'", "+callbacks.x.dirpath='1'"),
        f"start={os.path.expanduser('~/1')}",
    ]


@pytest.mark.parametrize(
    "word",
    [
        *("seed=1,2", "model=tiny", "resume=null", "outputs=${oc.env:HOME}/runs", "-m", "labels"),
        *("images='a b'", "overrides=['data.root=1']", "data.root=data/streets"),
        "hydra.run.dir=outputs/${now:%Y}",
    ],
)
def test_other_words_stay(word):
    assert literal_path(word) == word


def test_a_sweep_keeps_its_commas():
    given = ["-m", "checkpoint=a,2024,ö.ckpt", "outputs='a,b',c", "images=choice(a,b)"]
    assert literal_paths(given) == ["-m", "checkpoint=a,'2024','ö.ckpt'", *given[2:]]
    assert literal_paths(given[1:2]) == ["checkpoint='a,2024,ö.ckpt'"]


@pytest.mark.parametrize(
    ("word", "fact"), [("data.root=", "data.root= is empty"), ("images=\udcff", "not Unicode")]
)
def test_a_path_that_cannot_be_meant_is_refused(word, fact):
    with pytest.raises(InputError, match=fact):
        literal_path(word)


def test_a_printed_command_can_be_copied():
    typed = ["stage=full", "data.root=it's (ö), 1", "init_from=2024"]
    command = command_line("occdetr.train", map(literal_path, typed))
    assert shlex.split(command) == ["python", "-m", "occdetr.train", *typed]
    assert as_typed("model='tiny'") == "model='tiny'"  # no path


def test_an_entry_point_passes_paths_on_to_another(tmp_path, monkeypatch, capsys):
    """As ``demo`` and ``study`` do: the path is in the error of the other program."""

    def run_here(command, **_):
        return SimpleNamespace(returncode=program("prepare", *command[3:]))

    monkeypatch.setattr("occdetr.cli.subprocesses.subprocess.run", run_here)
    root = tmp_path / "2024 (ö), 'a'"
    given = ["data=semantickitti", f"data.root={root}"]
    with pytest.raises(SystemExit):
        run_entry_point("prepare", given, tmp_path / "a=b, c")
    assert f"error: {root}: no dataset there" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "settings"),
    [
        ("seed=5", ["seed"]),
        ("++data.seed=5", ["data.seed"]),
        ("~data.flip", ["data.flip"]),
        ("data=synthetic", ["data"]),
        ("experiment@_global_=demo", ["experiment"]),
        ("data={seed: 5, objects: {ray_stride: 1}}", ["data.seed", "data.objects.ray_stride"]),
        ("data.root=~/ä (1), b=c", ["data.root"]),
        ("data.seed=[", []),
    ],
)
def test_what_an_override_changes(override, settings):
    assert changed_settings(override) == settings


def test_overrides_of_a_group_are_found_in_every_form():
    given = ["data.seed=5", "++data.flip=0", "~data.scale", "data={seed: 6}"]
    others = ["data=synthetic", "database.seed=1", "seed=5", "model.data.x=1"]
    assert overrides_of("data", [*given, *others]) == given


def test_an_override_of_what_a_program_decides_is_refused():
    decided = {"data": "give data= beside it", "*_share": "leave it out"}
    refuse_overrides(["data.seed=5", "share=1", "data={seed: 5}"], decided)
    with pytest.raises(InputError, match="overrides: data=synthetic: give data= beside it"):
        refuse_overrides(["seed=5", "data=synthetic"], decided)
    with pytest.raises(InputError, match="leave it out"):
        refuse_overrides(["a={b_share: 1}"], decided)
