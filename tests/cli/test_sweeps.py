"""Sweeps (``-m``): what is checked before the first job, and what Hydra's plugins are given."""

from __future__ import annotations

import os
import re
import stat
import sys

import hydra
import pytest
import yaml
from omegaconf import OmegaConf

from occdetr.cli import entry as cli
from occdetr.cli import plugins
from occdetr.cli.plugins import prefer_own_options
from occdetr.errors import InputError
from programs import program, subprogram, the_error

LAUNCHERS = ("slurm", "submitit_local", "joblib")


def hydra_node(entry, *overrides):
    """The node ``hydra`` of a command, with the settings that it refers to."""
    prefer_own_options(cli.config_dir())
    with hydra.initialize_config_dir(str(cli.config_dir()), version_base="1.3"):
        config = hydra.compose(entry, list(overrides), return_hydra_config=True)
    config.hydra.job.name = entry
    return config.hydra


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A machine with commands of SLURM, of which ``sbatch`` refuses every job."""
    refuse = "#!/bin/sh\necho 'sbatch: error: invalid partition specified' >&2\nexit 1\n"
    for name in ("srun", "sbatch"):
        file = tmp_path / "bin" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(refuse)
        file.chmod(file.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}/bin{os.pathsep}{os.environ['PATH']}")


# ----------------------------------------------------------------------------- configuration


@pytest.mark.parametrize("launcher", LAUNCHERS)
@pytest.mark.parametrize("entry", ["train", "evaluate", "prepare", "study"])
def test_each_launcher_composes_with_each_command(entry, launcher):
    node = hydra_node(entry, f"hydra/launcher={launcher}").launcher
    OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    assert node._target_.startswith("hydra_plugins.")


def test_tasks_follow_the_trainer():
    given = ("trainer=ddp", "trainer.devices=8", "trainer.num_nodes=2")
    node = hydra_node("train", *given, "hydra/launcher=slurm").launcher
    assert (node.nodes, node.tasks_per_node, node.gpus_per_node) == (2, 8, 8)
    local = hydra_node("train", *given[:2], "hydra/launcher=submitit_local").launcher
    assert (local.nodes, local.tasks_per_node, local.gpus_per_node) == (1, 8, 8)
    assert hydra_node("prepare", "hydra/launcher=slurm").launcher.tasks_per_node == 1


def test_the_script_for_sbatch(slurm, tmp_path):
    """And what sbatch says of it is one line. In a process of its own: what checks the shapes in
    tests cannot be handed to jobs."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    own = ("partition=gpu", "timeout_min=90", "setup=['module load cuda']")
    node = [f"hydra.launcher.{text}" for text in own]
    given = ("seed=0,1", "trainer=ddp", "trainer.devices=4", "trainer.num_nodes=2")
    place = (f"outputs={tmp_path}/out", "hydra/launcher=slurm")
    done = subprogram("train", "-m", *given, *node, *place)
    assert done.returncode == 2, done.stderr
    line = done.stderr.splitlines()[-1]
    assert line.startswith("error: hydra/launcher: ")
    assert "invalid partition specified" in line
    (script,) = (tmp_path / "out/.submitit").rglob("*.sh")
    lines = script.read_text().splitlines()
    flags = dict(re.fullmatch(r"#SBATCH --([\w-]+)=?(.*)", text).groups()
                 for text in lines if text.startswith("#SBATCH"))  # fmt: skip
    wanted = {
        **{"partition": "gpu", "time": "90", "nodes": "2", "ntasks-per-node": "4"},
        **{"gpus-per-node": "4", "cpus-per-task": "8", "mem": "64GB", "requeue": ""},
        **{"array": "0-1%2", "signal": "USR2@120", "open-mode": "append", "job-name": "train"},
    }
    assert {key: flags[key] for key in wanted} == wanted
    assert "module load cuda" in lines
    assert lines[-1].startswith("srun ")
    assert "--kill-on-bad-exit=1" in lines[-1]


# ------------------------------------------------------------------- before the first job


@pytest.mark.parametrize(
    ("choice", "package"),
    [
        *((f"hydra/launcher={name}", "hydra-submitit-launcher") for name in LAUNCHERS[:2]),
        ("hydra/launcher=joblib", "hydra-joblib-launcher"),
        ("hydra/sweeper=optuna", "hydra-optuna-sweeper"),
    ],
)
def test_a_plugin_that_is_missing_is_named(choice, package, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plugins, "_is_installed", lambda name: False)
    assert program("train", "-m", "seed=0,1", choice, f"outputs={tmp_path}/out") == 2
    line = the_error(capsys)
    assert f"{choice}: {package} is not installed: pip install 'occdetr[sweeps]'" in line
    assert not (tmp_path / "out").exists()


def test_slurm_needs_its_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plugins, "_is_installed", lambda name: True)
    monkeypatch.setenv("PATH", str(tmp_path))
    given = ("seed=0,1", "hydra/launcher=slurm", f"outputs={tmp_path}/out")
    assert program("train", "-m", *given) == 2
    assert "there is no sbatch here" in the_error(capsys)


@pytest.mark.parametrize(
    ("given", "fact"),
    [
        (
            "hydra/launcher=slrum",
            "hydra/launcher=slrum: no such option: choose one of basic, joblib",
        ),
        ("hydra.sweeper.trials=3", "hydra.sweeper.trials: no such setting: --cfg hydra"),
    ],
)
def test_what_hydra_does_not_have_is_named(given, fact, tmp_path, capsys):
    assert program("train", "-m", "seed=0,1", given, f"outputs={tmp_path}/out") == 2
    assert fact in the_error(capsys)


@pytest.mark.parametrize("choice", ["hydra/launcher=slurm", "hydra/sweeper=optuna"])
def test_without_a_sweep_there_is_nothing_to_launch(choice, tmp_path, capsys):
    assert program("train", choice, f"outputs={tmp_path}/out") == 2
    assert f"{choice}: is for a sweep: add -m" in the_error(capsys)


@pytest.mark.parametrize(
    ("given", "fact"),
    [
        (("trainer.devices=auto",), "trainer.devices=auto: give a number"),
        (("trainer.devices=1,2",), "trainer.devices=2: hydra.launcher.tasks_per_node is 1"),
        (("trainer.num_nodes=2",), "trainer.num_nodes=2: hydra.launcher.nodes is 1"),
        (("stage=pretrain,full",), "stage=pretrain,full: hydra/launcher=submitit_local runs both"),
        (("seed=0,1.5",), "seed=1.5"),
        (("seed=0,1", "hydra.launcher.timeout_min=soon"), "timeout_min"),
    ],
)
def test_jobs_that_cannot_run_are_refused(given, fact, tmp_path, monkeypatch, capsys):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    local = ("hydra/launcher=submitit_local", f"outputs={tmp_path}/out")
    assert program("train", "-m", *given, *local) == 2
    assert fact in the_error(capsys)
    assert not list(tmp_path.rglob("*.ckpt"))


# ------------------------------------------------------------------------------------- jobs


def jobs_of(task, folder, monkeypatch, *overrides):
    """Run ``task`` as the jobs of a sweep of ``train`` in this process; the exit code."""
    program_of_task = cli.entry_point("train")(task)
    words = ["train.py", "-m", f"outputs={folder}", *overrides]
    monkeypatch.setattr(sys, "argv", words)
    try:
        program_of_task()
    except SystemExit as end:
        return end.code
    return 0


def test_the_folders_of_a_sweep_share_its_time(tmp_path, monkeypatch):
    """Also of jobs that start later, or for a second time."""
    from datetime import datetime

    class Clock(datetime):
        seconds = 0

        @classmethod
        def now(cls, tz=None):
            cls.seconds += 1
            return cls(2024, 5, 1, second=cls.seconds)

    monkeypatch.setattr("hydra.core.utils.datetime", Clock)

    def task(config):
        (cli.run_folder() / "config.yaml").touch()

    assert jobs_of(task, tmp_path, monkeypatch, "seed=0,1,2") == 0
    names = sorted(folder.name for folder in tmp_path.glob("pretrain/*/"))
    assert [name.rpartition("_")[2] for name in names] == ["0", "1", "2"]
    assert len({name.rpartition("_")[0] for name in names}) == 1


def test_a_search_goes_on_after_a_trial_that_fails(tmp_path, monkeypatch, capsys):
    """It maximises what a training returns."""
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    seen = []

    def task(config):
        seen.append(config.optimizer.lr)
        if len(seen) == 2:
            raise InputError("loss cls is nan")
        return -abs(config.optimizer.lr - 3e-3)

    space = "optimizer.lr=tag(log,interval(1e-4,1e-1))"
    storage = f"hydra.sweeper.storage=sqlite:///{tmp_path}/out/search.db"
    chosen = ("hydra/sweeper=optuna", "hydra.sweeper.n_trials=5", "seed=1", storage)
    assert jobs_of(task, tmp_path / "out", monkeypatch, space, *chosen) == 0
    assert len(set(seen)) == 5
    assert all(1e-4 <= lr <= 1e-1 for lr in seen)
    best = yaml.safe_load((tmp_path / "out/optimization_results.yaml").read_text())
    others = [lr for lr in seen if lr != seen[1]]
    assert best["best_params"]["optimizer.lr"] == min(others, key=lambda lr: abs(lr - 3e-3))


def test_a_search_without_a_result_ends_with_one_line(tmp_path, monkeypatch, capsys):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")

    def task(config):
        raise InputError("no dataset there")

    chosen = ("hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "seed=choice(1,2)")
    assert jobs_of(task, tmp_path, monkeypatch, *chosen) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: hydra/sweeper: ")


LOST = """Job 100_3 (task: 0) with path /out/.submitit/100_3/100_3_0_result.pkl
has not produced any output (state: FAILED)
Error stream produced:
----------------------------------------
warning: one
error: out of GPU memory: lower data.batch_size
srun: error: node1: task 0: Exited with exit code 2
"""
ENDED, WHERE = "job 100_3 ended without a result", "its output is in /out/.submitit/100_3"


@pytest.mark.parametrize(
    ("module", "text", "line"),
    [
        ("submitit.core.core", LOST, f"{ENDED}: out of GPU memory: lower data.batch_size; {WHERE}"),
        ("submitit.core.core", LOST.replace("error: out", "out"),
         f"{ENDED}: srun: error: node1: task 0: Exited with exit code 2; {WHERE}"),
        ("optuna.study.study", "No trials are\ncompleted yet.",
         "hydra/sweeper: No trials are completed yet."),
        ("occdetr.train", "a defect", None),
    ],
)  # fmt: skip
def test_what_a_plugin_raises_is_one_line(module, text, line):
    scope = {"__name__": module}
    exec("def fail(text): raise RuntimeError(text)", scope)
    with pytest.raises(RuntimeError) as caught:
        scope["fail"](text)
    assert plugins.explain_plugin(caught.value) == line
