"""``part=all``: which runs, and their tables."""

import pytest

from occdetr.benchmark import runs
from programs import program, the_error


@pytest.fixture
def started(monkeypatch):
    found = []

    def run_entry_point(entry, overrides, folder, _environment):
        found.append([entry, *overrides])
        folder.mkdir()
        (folder / "benchmark.md").write_text(f"table of {folder.name}\n")

    monkeypatch.setattr(runs, "run_entry_point", run_entry_point)
    return found


def test_every_run_gets_its_settings_and_then_those_given(started, tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "check_peer", lambda: None)
    given = ("part=all", "repeats=2", f"hydra.run.dir={tmp_path / 'all'}")
    assert program("benchmark", *given) == 0
    peer = ["vs=transformers", "model=paper", "repeats=5", "warmup=1"]
    assert started[0] == ["benchmark", *peer, "repeats=2"]
    assert [run[-1] for run in started] == ["repeats=2"] * 6
    document = (tmp_path / "all/benchmark.md").read_text()
    names = ("peer", "paper", "tiny", "pretrain", "full", "scaling")
    assert document == "\n".join(f"table of {name}\n" for name in names)


def test_a_compiled_network_is_for_the_run_beside_another_project(started, tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "check_peer", lambda: None)
    given = ("part=all", "compile=true", f"hydra.run.dir={tmp_path / 'all'}")
    assert program("benchmark", *given) == 0
    assert ["compile=true" in run for run in started] == [True] + [False] * 5


def test_a_missing_package_is_said_before_the_first_run(started, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    assert program("benchmark", "part=all", f"hydra.run.dir={tmp_path / 'all'}") == 2
    assert "pip install 'occdetr[benchmark]'" in the_error(capsys)
    assert started == []
