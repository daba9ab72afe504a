"""The command ``occdetr``."""

import subprocess
import sys

import pytest

from occdetr.cli import main as command


def run(*arguments, monkeypatch):
    """Run the command here; its exit code."""
    monkeypatch.setattr(sys, "argv", ["occdetr", *arguments])
    try:
        command.main()
    except SystemExit as end:
        return end.code
    return 0


@pytest.mark.parametrize("arguments", [(), ("--help",)])
def test_help_lists_every_command(arguments, monkeypatch, capsys):
    assert run(*arguments, monkeypatch=monkeypatch) == 0
    shown = [line.split() for line in capsys.readouterr().out.splitlines() if line[:2] == "  "]
    assert [words[0] for words in shown] == list(command.COMMANDS)
    assert all(len(words) > 3 for words in shown)


@pytest.mark.parametrize(("name", "advice"), [("trian", "train"), ("fly", "choose one of train")])
def test_unknown_command(name, advice, monkeypatch, capsys):
    assert run(name, monkeypatch=monkeypatch) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {name}: no such command")
    assert advice in line


def test_a_command_is_what_python_m_runs(tmp_path, monkeypatch, capsys):
    """Lightning starts further ranks as ``python -m`` with the name in ``__main__.__spec__``."""
    text = "import sys, __main__; print(__name__, __main__.__spec__.name, sys.argv[1:])"
    (tmp_path / "a_program.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(command.COMMANDS, "probe", ("a_program", "for this test"))
    assert run("probe", "a=1", "-m", monkeypatch=monkeypatch) == 0
    assert capsys.readouterr().out.strip() == "__main__ a_program ['a=1', '-m']"


def test_help_of_a_command_is_hydras():
    code = "from occdetr.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "train", "--help"], capture_output=True, text=True, check=True
    )
    assert "== Configuration groups ==" in done.stdout
    assert "scheduler: constant, cosine, linear" in done.stdout
