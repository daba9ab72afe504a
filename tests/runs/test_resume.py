"""Runs that are killed or stopped and resumed end as if nothing had happened."""

import multiprocessing
import os
import signal
import socket
import subprocess
import sys

import pytest
import torch
from lightning.pytorch.callbacks import Callback

from crash import Killed, crash
from occdetr.training.checkpoint import read_checkpoint
from programs import SMALL, newest, program, read_json, subprogram, the_error


@pytest.fixture
def settings(streets):
    """Trainings of 4 frames, 2 batches an epoch."""
    data = ("data=semantickitti", f"data.root={streets}", "data.stride=1", "data.num_workers=1")
    splits = ("data.train_sequences=[0,8]", "data.val_sequences=[0]")
    return (*SMALL, "trainer=cpu", *data, *splits, "logger=none", "trainer.max_epochs=2")


EVERY_STEP = ("callbacks=checkpoint", "callbacks.checkpoint.every_steps=1")


def result(folder):
    """What a run ends with, without its settings, paths and times."""
    last = torch.load(folder / "last.ckpt", weights_only=True)
    best = torch.load(folder / "best.ckpt", weights_only=True)
    metrics = read_json(folder / "metrics.json")
    del metrics["seconds"], metrics["peak_memory_mb"]
    scores = [
        state["best_model_score"]
        for name, state in best["callbacks"].items()
        if name.startswith("RunCheckpoint")
    ]
    kept = ("state_dict", "optimizer_states", "lr_schedulers", "global_step", "epoch", "loops")
    return [{name: last[name] for name in kept}, best["state_dict"], scores, metrics]


def assert_equal(one, other):
    """To the last bit."""
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_equal(*pair)
    else:
        assert one == other


@pytest.mark.parametrize(
    ("stage", "kills", "more"),
    [
        ("pretrain", [1, 3], ()),
        pytest.param("pretrain", [1, 3], ("data.num_workers=0",), marks=pytest.mark.slow),
        pytest.param("full", [1, 2, 3], (), marks=pytest.mark.slow),
        pytest.param(
            *("pretrain", [1, 2]),
            ("trainer.accumulate_grad_batches=2", "data.batch_size=1", "data.num_workers=2"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_killed_run_ends_as_an_uninterrupted_one(stage, kills, more, settings, tmp_path):
    """Killed in the middle of epochs and, after 2 steps, at the end of one."""
    start = ("init_from=scratch",) if stage == "full" else ()
    given = (f"stage={stage}", *start, *settings, *EVERY_STEP, *more)
    assert program("train", *given, f"hydra.run.dir={tmp_path}/whole", "outputs=none") == 0
    given = (*given, f"outputs={tmp_path}", "resume=allow")
    for number, steps in enumerate(kills):
        with pytest.raises(Killed):
            program("train", *given, f"hydra.run.dir={tmp_path}/{stage}/{number}", crash(steps))
    assert program("train", *given, f"hydra.run.dir={tmp_path}/{stage}/end") == 0
    assert_equal(result(tmp_path / "whole"), result(tmp_path / stage / "end"))


class StopAt(Callback):
    """Sends a signal in the first step, to the loader's workers and then to this process, as if to
    their process group."""

    def __init__(self, number):
        self.number = number

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        if trainer.global_step == 0:
            workers = [str(child.pid) for child in multiprocessing.active_children()]
            assert workers
            for process in (*workers, str(os.getpid())):  # the workers' parent is not the sender
                subprocess.run(["kill", f"-{self.number}", process], check=True)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGUSR1"])
def test_a_signal_writes_a_checkpoint_and_says_how_to_continue(name, settings, tmp_path, capsys):
    number = int(getattr(signal, name))
    stop = f"trainer.callbacks=[{{_target_: test_resume.StopAt, number: {number}}}]"
    given = ("stage=pretrain", *settings, f"hydra.run.dir={tmp_path}/run", stop)
    before = signal.getsignal(number)
    assert program("train", *given) == 75
    assert not multiprocessing.active_children()
    assert signal.getsignal(number) == before
    line = capsys.readouterr().out.splitlines()[-1]
    assert f"stopped by {name} after 1 steps" in line
    assert f"resume={tmp_path}/run" in line
    assert "'image_size=[64,208]'" in line  # for a shell
    raw = torch.load(tmp_path / "run/last.ckpt", weights_only=True)
    assert raw["global_step"] == 1
    assert not (tmp_path / "run/metrics.json").exists()


def test_a_resumed_run_takes_over_what_may_change_and_says_so(settings, tmp_path, capsys):
    """Twice the batch size: one step an epoch instead of two, and half the schedule is over."""
    shorter = ("stage=pretrain", *settings, *EVERY_STEP, "scheduler.warmup_steps=1")
    with pytest.raises(Killed):
        program("train", *shorter, f"hydra.run.dir={tmp_path}/a", crash(2))
    changed = ("data.batch_size=4", "optimizer.lr=2e-4", "optimizer.weight_decay=0")
    resume = (f"resume={tmp_path}/a", f"hydra.run.dir={tmp_path}/b")
    capsys.readouterr()
    assert program("train", *shorter, *changed, *resume) == 0
    out = capsys.readouterr().out
    assert "resume: data.batch_size 2 -> 4" in out
    assert "resume: optimizer.lr 0.001 -> 0.0002" in out
    raw = torch.load(tmp_path / "b/last.ckpt", weights_only=True)
    assert raw["global_step"] == 3
    assert raw["occdetr"]["schedule"] == {"steps_per_epoch": 2, "position": 4}
    assert {group["lr"] for group in raw["optimizer_states"][0]["param_groups"]} == {0}  # the end
    assert {group["weight_decay"] for group in raw["optimizer_states"][0]["param_groups"]} == {0}
    assert max(raw["lr_schedulers"][0]["base_lrs"]) == 0.01  # Muon's
    assert 2e-4 in raw["lr_schedulers"][0]["base_lrs"]
    fixed = ("seed=1", "optimizer=adamw", "scheduler=cosine", "data.val_sequences=[8]")
    for override in (*fixed, "data.repeats=2"):
        assert program("train", *shorter, *resume[:1], override) == 2
        assert "cannot change in the middle of a run" in the_error(capsys)
    unused = ("init_from=scratch", "resume=auto")
    assert program("train", *shorter, unused[0]) == 2
    assert "init_from=scratch: stage=pretrain does not use it" in the_error(capsys)


@pytest.mark.slow
def test_another_number_of_devices_keeps_the_schedule(settings, tmp_path):
    """Half of it is over; then two processes take one step an epoch instead of two."""
    given = ("stage=pretrain", *settings, *EVERY_STEP, "data.val_sequences=[8]")
    with pytest.raises(Killed):
        program("train", *given, f"hydra.run.dir={tmp_path}/a", crash(2))
    ranks = ("trainer.devices=2", "trainer.strategy=ddp")
    resume = (f"resume={tmp_path}/a", f"hydra.run.dir={tmp_path}/b")
    done = subprogram("train", *given, *ranks, *resume)
    assert done.returncode == 0, done.stderr
    raw = torch.load(tmp_path / "b/last.ckpt", weights_only=True)
    assert raw["global_step"] == 3
    assert raw["occdetr"]["schedule"] == {"steps_per_epoch": 2, "position": 4}


@pytest.mark.slow
def test_a_sweep_pairs_each_full_training_with_its_own_pretraining(settings, tmp_path):
    given = (*settings, f"outputs={tmp_path}", "trainer.max_epochs=1")
    assert program("train", "-m", "stage=pretrain,full", "seed=0,1", *given) == 0
    weights = {}
    for path in tmp_path.glob("*/*/last.ckpt"):
        checkpoint = read_checkpoint(path)
        kernel = checkpoint.model_state["encoder.layers.0.feed_forward.linear1.weight"]
        weights[checkpoint.stage, checkpoint.config["seed"]] = kernel
    assert len(weights) == 4
    for seed in (0, 1):
        steps = [weights["full", seed] - weights["pretrain", other] for other in (seed, 1 - seed)]
        own, wrong = (step.abs().max() for step in steps)
        assert own < 1e-3 < wrong


@pytest.mark.slow
@pytest.mark.parametrize("stop", [False, True])
def test_ranks_from_outside_share_one_folder(stop, settings, tmp_path):
    """With the variables that torchrun sets."""
    ddp = [text for text in settings if text != "trainer=cpu"] + ["trainer=ddp"]
    ddp += ["trainer.accelerator=cpu", "data.val_sequences=[8]"]  # a frame for each rank
    given = ["stage=pretrain", *ddp, f"outputs={tmp_path}"]
    if stop:
        given.append(f"trainer.callbacks=[{{_target_: test_resume.StopAt, number: {15}}}]")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    group = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    processes = []
    for rank in ("1", "0"):
        own = {**os.environ, **group, "RANK": rank, "LOCAL_RANK": rank}
        own["PYTHONPATH"] = os.pathsep.join(sys.path)
        command = [sys.executable, "-m", "occdetr.train", *given]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        processes.append(subprocess.Popen(command, env=own, **pipes))
    outputs = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [75 * stop] * 2, outputs
    (folder,) = tmp_path.glob("pretrain/*/")
    assert (folder / "metrics.json").is_file() != stop
    step = torch.load(newest(folder, "last.ckpt"), weights_only=True)["global_step"]
    assert step == (1 if stop else 2)
