"""Trends of long runs."""

import subprocess
import sys
from contextlib import closing

import numpy as np
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from faults.growth import UNITS, series, trend
from faults.soak import sampled


def test_growth_is_that_of_the_trend_after_the_start():
    hours = np.linspace(0, 2, 400)
    noise = np.random.default_rng(0).normal(0, 1, 400)
    start = np.where(hours < 0.15, 100 - 500 * hours, 0)  # caches fill in the first tenth
    assert trend("memory", hours, 1000 + noise - start).flat
    rising = trend("memory", hours, 1000 + noise - start + 50 * hours)
    assert not rising.flat
    np.testing.assert_allclose(rising.growth, 0.9 * 2 * 50 / 1055, rtol=0.02)


def test_a_run_is_looked_at_from_the_end_of_its_first_validation_on(tmp_path):
    lines = ["time," + ",".join(name for name in UNITS if name != "step")]
    lines += [f"{time},1,1,1,1,1" for time in range(0, 3600, 60)]
    (tmp_path / "samples.csv").write_text("\n".join(lines))
    assert len(series(tmp_path)["memory"][0]) == 60  # neither a step nor a validation yet
    with closing(EventFileWriter(str(tmp_path / "run" / "tensorboard"))) as writer:
        for name, times in (("time/step", range(600, 3600, 10)), ("val/AP50", (1800, 2700))):
            for time in times:
                value = Summary(value=[Summary.Value(tag=name, simple_value=0.5)])
                writer.add_event(Event(wall_time=time, summary=value))
    found = series(tmp_path)
    assert len(found["memory"][0]) == 30
    assert len(found["step"][0]) == 180
    assert found["step"][0][0] == 0


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
