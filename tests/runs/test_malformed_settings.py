"""Settings that are impossible, contradictory or without effect stop a run before it starts."""

import pytest

from malformed_settings import malformed_settings
from programs import program, the_error

CASES = malformed_settings()
#: Each kind keeps cases among the fast tests: every second one.
PARAMETERS = [
    pytest.param(case, id=case.name, marks=[pytest.mark.slow] if number % 2 else [])
    for number, case in enumerate(CASES)
]


def test_there_are_many_and_their_names_differ():
    assert len({case.name for case in CASES}) == len(CASES) >= 60


@pytest.mark.parametrize("case", PARAMETERS)
def test_a_malformed_setting_is_named_in_one_line(case, tmp_path, capsys):
    overrides = case.make(tmp_path)
    setting = overrides[-1].lstrip("+").split("=")[0]
    assert program(case.command, *overrides) in case.codes
    assert setting in the_error(capsys)
    written = {path.name for path in tmp_path.glob("*")} | {
        path.name for path in tmp_path.glob("run/*")
    }
    assert written <= {"run", ".hydra", "config.yaml"}  # no data, no checkpoint, no logs
