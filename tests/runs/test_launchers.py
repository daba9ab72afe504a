"""Jobs of a sweep in processes that Hydra's plugins start: joblib, submitit here and on SLURM."""

import os
import signal
import sys

import pytest
import torch
from lightning.pytorch.callbacks import Callback

from programs import SMALL, STREETS, newest, read_json, subprogram
from slurm_stand_in import install

pytestmark = pytest.mark.slow

TWO_RANKS = ("trainer=ddp", "trainer.accelerator=cpu")
STOP = "trainer.callbacks=[{_target_: test_launchers.StopOnce}]"


class StopOnce(Callback):
    """Sends this process a signal after the first step, as SLURM does before the time limit."""

    def on_train_batch_end(self, trainer, module, *args):
        if trainer.global_step == 1:
            os.kill(os.getpid(), signal.SIGUSR2)


@pytest.fixture
def given(streets, tmp_path, monkeypatch):
    """Settings of trainings of 2 + 3 frames, without a Trainer; jobs find the tests' modules."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    data = (*STREETS, f"data.root={streets}", f"outputs={tmp_path}/out", "logger=none")
    return ("stage=pretrain", *SMALL, *data)


def folders(tmp_path):
    return sorted(tmp_path.glob("out/pretrain/*/"))


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_jobs_of_other_processes_are_runs_like_others(launcher, given, tmp_path):
    """Each has its folder; one that fails is reported, and the other one goes on."""
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher")
    model = "model.slots.num_slots=0,24"  # what no check before the jobs refuses
    further = ("data.num_workers=2", f"data.cache_dir={tmp_path}/labels")  # processes of a job
    settings = ("trainer=cpu", "trainer.max_epochs=1", model, *further)
    done = subprogram("train", "-m", *given, *settings, f"hydra/launcher={launcher}")
    assert done.returncode == 2, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("error: ")
    assert "num_slots" in last
    (finished,) = folders(tmp_path)
    assert read_json(finished / "metrics.json")["steps"] == 1


@pytest.mark.parametrize("launcher", ["submitit_local", "slurm"])
def test_a_job_of_two_ranks_is_requeued_after_its_checkpoint_and_continued(
    launcher, given, tmp_path, monkeypatch
):
    """On two nodes with SLURM; both ranks get the signal, and the job is requeued once."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    size = ("trainer.devices=2",)
    if launcher == "slurm":
        commands = install(tmp_path / "bin")
        monkeypatch.setenv("PATH", f"{commands}{os.pathsep}{os.environ['PATH']}")
        size = ("trainer.devices=1", "trainer.num_nodes=2")
    settings = (*TWO_RANKS, *size, "trainer.max_epochs=2", "resume=allow", STOP)
    done = subprogram("train", "-m", *given, *settings, f"hydra/launcher={launcher}")
    assert done.returncode == 0, done.stderr
    stopped, continued = folders(tmp_path)
    assert continued.name == f"{stopped.name}_1"
    assert not (stopped / "metrics.json").exists()
    assert torch.load(stopped / "last.ckpt", weights_only=True)["global_step"] == 1
    assert read_json(continued / "metrics.json")["steps"] == 2
    log = newest(tmp_path, "out/.submitit/*/*_0_log.out").read_text()
    assert log.count("stopped by SIGUSR2 after 1 steps") == 1
    assert f"resuming: {stopped / 'last.ckpt'}" in log


def test_a_sweep_that_is_started_again_has_its_results(given, tmp_path):
    settings = ("trainer=cpu", "trainer.max_epochs=1", "resume=allow", "optimizer.lr=1e-3,2e-3")
    first = subprogram("train", "-m", *given, *settings)
    assert first.returncode == 0, first.stderr
    before = folders(tmp_path)
    again = subprogram("train", "-m", *given, *settings)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("done before: ") == 2
    assert folders(tmp_path) == before
    assert len(before) == 2
