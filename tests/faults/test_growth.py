"""Trends of long runs."""

import subprocess
import sys

import numpy as np

from faults.growth import trend
from faults.soak import sampled


def test_growth_is_that_of_the_trend_after_the_start():
    hours = np.linspace(0, 2, 400)
    noise = np.random.default_rng(0).normal(0, 1, 400)
    start = np.where(hours < 0.15, 100 - 500 * hours, 0)  # caches fill in the first tenth
    assert trend("memory", hours, 1000 + noise - start).flat
    rising = trend("memory", hours, 1000 + noise - start + 50 * hours)
    assert not rising.flat
    np.testing.assert_allclose(rising.growth, 0.9 * 2 * 50 / 1055, rtol=0.02)


def test_outliers_do_not_move_a_trend():
    hours, seconds = np.linspace(0, 2, 400), np.full(400, 0.5)
    seconds[-20:] = 30.0  # another program had the processor
    assert trend("step", hours, seconds).growth == 0


def test_a_session_is_sampled(tmp_path):
    """A process that opens five files and then tells so."""
    code = "import sys; files = [open(sys.argv[1], 'a') for _ in range(5)]; print(); input()"
    given = [sys.executable, "-c", code, tmp_path / "file"]
    pipe = subprocess.PIPE
    (tmp_path / "large").write_bytes(bytes(2**20))
    with subprocess.Popen(given, stdin=pipe, stdout=pipe, start_new_session=True) as process:
        assert process.stdout
        process.stdout.readline()
        sample = sampled(process.pid, tmp_path)
        process.communicate(b"\n")
    assert (sample["processes"], sample["threads"], sample["handles"]) == (1, 1, 3 + 5)
    assert sample["memory"] > 1
    assert sample["disk"] >= 1
