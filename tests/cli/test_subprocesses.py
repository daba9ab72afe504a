"""Entry points in processes of their own: their cores and variables."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from occdetr import CORES
from occdetr.cli import subprocesses

BOUND = """
import os, torch
import occdetr
from occdetr.data.processes import available_cores
from occdetr.models.sampling.cpu import _pool
torch.ones(2**20).add(1)
sampling = _pool(os.getpid(), 1).submit(os.sched_getaffinity, 0).result()
occdetr.use_all_cores()
print(len(occdetr.CORES), len(sampling), available_cores(), len(os.sched_getaffinity(0)))
"""


@pytest.fixture
def started(monkeypatch):
    """The cores and the variables of each process."""
    found = []

    def run(_arguments, env, check):
        found.append((os.sched_getaffinity(0), env))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(subprocesses.subprocess, "run", run)
    return found


@pytest.mark.skipif(CORES is None, reason="no function for the cores here")
def test_a_process_has_all_cores_though_this_one_is_bound(started, tmp_path):
    os.sched_setaffinity(0, {min(CORES)})
    subprocesses.run_entry_point("benchmark", [], tmp_path / "run")
    assert started[0][0] == CORES


@pytest.mark.skipif(CORES is None or len(CORES) < 2, reason="needs two cores, and to know them")
def test_openmps_binding_is_openmps_alone():
    """The sampling's threads, and what is started, run on all cores."""
    program = [sys.executable, "-c", "import occdetr\n" + BOUND]
    variables = {**os.environ, "OMP_PROC_BIND": "close"}
    printed = subprocess.run(program, env=variables, check=True, capture_output=True, text=True)
    counts = [int(word) for word in printed.stdout.split()]
    assert counts[0] == counts[1] == counts[3] == len(CORES)
    assert 1 <= counts[2] <= len(CORES)


def test_variables_of_this_process_come_first(started, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_PROC_BIND", "spread")
    monkeypatch.delenv("MALLOC_MMAP_MAX_", raising=False)
    given = {"OMP_PROC_BIND": "close", "MALLOC_MMAP_MAX_": "0"}
    subprocesses.run_entry_point("benchmark", [], tmp_path / "run", given)
    _, env = started[0]
    assert (env["OMP_PROC_BIND"], env["MALLOC_MMAP_MAX_"]) == ("spread", "0")
