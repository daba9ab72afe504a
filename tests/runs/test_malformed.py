"""Malformed inputs: each is refused in one line, with its exit code and nothing half written."""

import re

import pytest

from malformed import malformed_inputs
from programs import program

CASES = malformed_inputs()
#: Those that need a network are tested in test_predict.py.
REFUSED = [case for case in CASES if case.kind != "pictures among others"]
#: Every sixth is in the default suite.
MARKED = [
    pytest.param(case, marks=[] if number % 6 == 0 else [pytest.mark.slow], id=case.name)
    for number, case in enumerate(REFUSED)
]


def files(folder):
    """The files below a folder other than Hydra's."""
    return {file for file in folder.rglob("*") if ".hydra" not in file.parts and file.is_file()}


def is_warning(line):
    return re.search(r"\bwarning:|Warning:|warnings\.warn", line) is not None


@pytest.mark.parametrize("case", MARKED)
def test_malformed_input(case, tmp_path, capfd):
    overrides = case.make(tmp_path)
    before = files(tmp_path)
    assert program(case.command, *overrides) in case.codes
    errors = capfd.readouterr().err.splitlines()
    assert [line[:7] for line in errors if not is_warning(line)] == ["error: "]
    assert files(tmp_path) == before


def test_names_differ():
    assert len({case.name for case in CASES}) == len(CASES) > 100
