"""Entry points in processes of their own: their cores and variables."""

import os
from types import SimpleNamespace

import pytest

from occdetr.cli import subprocesses


@pytest.fixture
def started(monkeypatch):
    """The cores and the variables of each process."""
    found = []

    def run(_arguments, env, check):
        found.append((os.sched_getaffinity(0), env))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(subprocesses.subprocess, "run", run)
    return found


@pytest.mark.skipif(subprocesses.CORES is None, reason="no function for the cores here")
def test_a_process_has_all_cores_though_this_one_is_bound(started, tmp_path):
    os.sched_setaffinity(0, {min(subprocesses.CORES)})
    subprocesses.run_entry_point("benchmark", [], tmp_path / "run")
    assert started[0][0] == subprocesses.CORES


def test_variables_of_this_process_come_first(started, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_PROC_BIND", "spread")
    monkeypatch.delenv("MALLOC_MMAP_MAX_", raising=False)
    given = {"OMP_PROC_BIND": "close", "MALLOC_MMAP_MAX_": "0"}
    subprocesses.run_entry_point("benchmark", [], tmp_path / "run", given)
    _, env = started[0]
    assert (env["OMP_PROC_BIND"], env["MALLOC_MMAP_MAX_"]) == ("spread", "0")
