"""Runs that are interrupted or killed leave whole files, and go on from them."""

import os
import signal
import subprocess
import sys
import time

import pytest

from occdetr.training.checkpoint import read_checkpoint
from programs import SHORT, STREETS, newest, program, read_json


def wait_until(condition, seconds=120):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)


@pytest.mark.slow
def test_interrupted_training_leaves_whole_files(streets, tmp_path):
    data = (*STREETS, f"data.root={streets}", f"outputs={tmp_path}")
    command = ["-m", "occdetr.train", "stage=pretrain", *SHORT, *data, "trainer.max_epochs=1000"]
    process = subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: list(tmp_path.glob("pretrain/*/last.ckpt")))
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.strip().splitlines()[-1] == "interrupted"
    assert read_checkpoint(newest(tmp_path, "pretrain/*/last.ckpt")).stage == "pretrain"
    assert not list(tmp_path.glob("pretrain/*/.*.tmp"))


@pytest.mark.slow
@pytest.mark.parametrize(("stop", "after"), [("Ctrl-C", 1), ("Ctrl-C", 10), ("kill", 10)])
def test_preparation_goes_on_after_a_stop(stop, after, streets, tmp_path):
    """After 1 frame the workers are starting, after 10 all are busy."""
    source, goal, count = streets / "sequences/00", tmp_path / "data/sequences/00", 200
    for folder in ("image_2", "voxels"):
        (goal / folder).mkdir(parents=True)
    os.link(source / "calib.txt", goal / "calib.txt")
    for number in range(count):  # the same street under many numbers
        for file in source.glob("*/000000.*"):
            os.link(file, goal / file.parent.name / f"{5 * number:06d}{file.suffix}")
    data = ("data=semantickitti", f"data.root={tmp_path / 'data'}", "data.train_sequences=[0]")
    given = (*data, "data.val_sequences=[0]", f"hydra.run.dir={tmp_path / 'run'}")
    process = subprocess.Popen(
        [sys.executable, "-m", "occdetr.prepare", *given, "workers=2"],
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True},
        start_new_session=True,  # a process group of its own, as a terminal gives
    )
    wait_until(lambda: len(list(tmp_path.glob("data/**/*.npz"))) >= after)
    if stop == "Ctrl-C":
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.kill()
    out, errors = process.communicate(timeout=60)  # it ends when the last worker has ended
    if stop == "Ctrl-C":
        assert (process.returncode, errors.strip()) == (130, "interrupted")
        assert "stopped after" in out
    there = len(list(tmp_path.glob("data/**/*.npz")))
    assert after <= there < count
    again = f"hydra.run.dir={tmp_path / 'again'}"
    assert program("prepare", *given[:-1], again, "workers=1") == 0
    report = read_json(tmp_path / "again/prepare.json")
    assert (report["reused"], report["built"]) == (there, count - there)
