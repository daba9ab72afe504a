"""Processes that compute in parallel: their results, their end, and what is said of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from occdetr.data.parallel import in_processes
from occdetr.errors import InputError


def double(number: int) -> int:
    time.sleep(0.1 / (1 + number))  # the last ones are ready first
    return 2 * number


def end(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wait(folder: Path) -> None:
    (folder / str(os.getpid())).touch()
    time.sleep(600)


def test_results_come_in_the_order_of_the_items() -> None:
    assert list(in_processes(double, range(5), workers=2)) == [0, 2, 4, 6, 8]


def test_a_killed_process_is_said() -> None:
    with pytest.raises(InputError, match="one of 2 processes was killed"):
        list(in_processes(end, range(3), workers=2))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_end_with_the_one_that_is_killed(tmp_path: Path) -> None:
    code = (
        "from pathlib import Path; from test_parallel import wait;"
        "from occdetr.data.parallel import in_processes;"
        f"list(in_processes(wait, [Path({str(tmp_path)!r})] * 4, workers=2))"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    )
    until(lambda: len(list(tmp_path.iterdir())) == 2 or parent.poll() is not None)
    workers = [int(path.name) for path in tmp_path.iterdir()]
    assert len(workers) == 2
    parent.kill()
    parent.wait()
    until(lambda: not any(map(runs, workers)))


def runs(process: int) -> bool:
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def until(condition) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)
