"""The folder of a run: taken once, and nobody else's files are removed."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from datetime import datetime

import pytest

from occdetr.cli import entry as cli
from occdetr.cli.folders import MARKER, remove_former_run, remove_leftovers, taken
from occdetr.errors import InputError
from occdetr.training.trainer import make_trainer
from programs import program, read_json, the_error


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def take(folder, entry="train", **options):
    with taken(folder, entry, "hydra.run.dir", **options) as place:
        return place


def test_a_folder_holds_one_run(tmp_path):
    assert take(tmp_path / "a") == tmp_path / "a"
    assert read_json(tmp_path / "a" / MARKER)["entry"] == "train"
    with pytest.raises(InputError, match=r"a: holds a run already: set hydra\.run\.dir"):
        take(tmp_path / "a")
    with pytest.raises(InputError, match="holds a run already"):
        take(tmp_path / "a", entry="demo", again=True)
    assert take(tmp_path / "a", again=True) == tmp_path / "a"


def test_a_default_name_gets_a_number_if_it_is_taken(tmp_path):
    places = [take(tmp_path / "now", numbered=True) for _ in range(3)]
    assert [place.name for place in places] == ["now", "now_1", "now_2"]


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("all of it")
    for again in (False, True):
        with pytest.raises(InputError, match="is not empty, and its files are not of a run"):
            take(tmp_path, again=again)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_folder_in_use_is_refused(tmp_path):
    with (
        taken(tmp_path / "a", "demo", "folder", again=True),
        pytest.raises(InputError, match="a: is in use by another run"),
    ):
        take(tmp_path / "a", entry="demo", again=True)


def test_a_refused_run_leaves_its_folder_free(tmp_path):
    with contextlib.suppress(InputError), taken(tmp_path / "a", "train", "folder") as folder:
        (folder / "config.yaml").touch()
        raise InputError("a reason")
    assert files(tmp_path) == {}
    with contextlib.suppress(InputError), taken(tmp_path / "b", "train", "folder") as folder:
        (folder / "last.ckpt").touch()
        raise InputError("a reason")
    with pytest.raises(InputError, match="holds a run already"):
        take(tmp_path / "b")


def test_leftovers_of_a_killed_run_are_removed(tmp_path):
    """Not those of a run that is going on, and not in a folder that no run has made."""
    name = f".last.ckpt.{'0' * 32}.tmp"
    with taken(tmp_path / "run", "train", "hydra.run.dir") as run:
        (run / name).touch()
        remove_leftovers(run)
        assert (run / name).exists()
    remove_leftovers(run)
    assert not (run / name).exists()
    (tmp_path / name).touch()
    remove_leftovers(tmp_path)
    assert (tmp_path / name).exists()


def test_a_former_run_is_removed_and_nothing_else(tmp_path):
    remove_former_run(tmp_path / "missing", "train")
    run = tmp_path / "run"
    take(run)
    for name in ("last.ckpt", "events.out.tfevents.1", "version_0/metrics.csv"):
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).touch()
    before = files(run)
    with pytest.raises(InputError, match="run: is not a run of evaluate"):
        remove_former_run(run, "evaluate")
    for foreign in ("notes.txt", "version_0/last.ckpt.bak"):
        (run / foreign).write_text("mine")
        with pytest.raises(InputError, match=f"{foreign}: was not made by a run of train"):
            remove_former_run(run, "train")
        (run / foreign).unlink()
    (run / "link.dat").symlink_to(tmp_path)
    with pytest.raises(InputError, match=r"link\.dat: was not made"):
        remove_former_run(run, "train")
    (run / "link.dat").unlink()
    assert files(run) == before
    with taken(run, "train", "folder", again=True), pytest.raises(InputError, match="is in use"):
        remove_former_run(run, "train")
    remove_former_run(run, "train")
    assert not run.exists()


@pytest.fixture
def benchmark(tmp_path, monkeypatch):
    """The quickest program: it writes a file and ends."""
    import occdetr.benchmark as entry
    from occdetr.benchmark.sheet import Sheet

    empty = Sheet("", [""])
    monkeypatch.setattr(entry, "measure_model", lambda config: ({"seed": config.seed}, empty))

    def run(*overrides):
        return program("benchmark", *overrides, "device=cpu")

    return run


def test_a_second_run_does_not_overwrite_the_first(benchmark, tmp_path, capsys):
    given = f"hydra.run.dir={tmp_path}/2024 (ö)"
    assert benchmark(given, "seed=1") == 0
    before = files(tmp_path)
    assert tmp_path / "2024 (ö)" / ".hydra" / "overrides.yaml" in before
    assert benchmark(given, "seed=2") == 2
    assert "2024 (ö): holds a run already: set hydra.run.dir" in the_error(capsys)
    assert files(tmp_path) == before
    (tmp_path / "other").mkdir()
    (tmp_path / "other/config.yaml").write_text("of another program")
    assert benchmark(f"hydra.run.dir={tmp_path}/other") == 2
    assert "other: is not empty" in the_error(capsys)
    assert (tmp_path / "other/config.yaml").read_text() == "of another program"
    assert len(list((tmp_path / "other").iterdir())) == 1


@pytest.mark.parametrize(("sweep", "seeds"), [((), [1, 2]), (("-m", "repeats=1,2"), [1, 1, 2, 2])])
def test_runs_of_the_same_second_have_folders_of_their_own(
    sweep, seeds, benchmark, tmp_path, monkeypatch
):
    class Still(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2024, 5, 1)

    monkeypatch.setattr("hydra.core.utils.datetime", Still)
    for seed in (1, 2):
        assert benchmark(*sweep, f"outputs={tmp_path}", f"seed={seed}") == 0
    found = [read_json(path)["seed"] for path in tmp_path.rglob("benchmark.json")]
    assert sorted(found) == seeds
    assert (tmp_path / f"benchmark/2024-05-01_00-00-00{'_0' if sweep else ''}_1").is_dir()


#: A program that says its folder; the clock of rank 1 is a second ahead.
RANK = """
from datetime import datetime

import hydra.core.utils
from lightning.fabric.utilities.rank_zero import rank_zero_only

from occdetr.cli import entry as cli


class Clock(datetime):
    @classmethod
    def now(cls, tz=None):
        return cls(2024, 5, 1, second=rank_zero_only.rank)


hydra.core.utils.datetime = Clock


@cli.entry_point("train")
def main(config):
    print(cli.run_folder().resolve())


main()
"""
#: The variables that tell a process its rank and the number of ranks.
LAUNCHERS = {
    "torchrun": ("RANK", "LOCAL_RANK", "WORLD_SIZE"),
    "srun": ("SLURM_PROCID", "SLURM_LOCALID", "SLURM_NTASKS"),
}


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_ranks_that_start_in_different_seconds_share_one_folder(launcher, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    job = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    job |= {"SLURM_NODEID": "0", "SLURM_NTASKS_PER_NODE": "2"}
    path = os.pathsep.join(sys.path)
    processes = []
    for rank in ("0", "1"):
        own = dict(zip(LAUNCHERS[launcher], (rank, rank, "2"), strict=True))
        command = [sys.executable, "-c", RANK, f"outputs={tmp_path}"]
        environment = {**os.environ, "PYTHONPATH": path, **job, **own}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        processes.append(subprocess.Popen(command, env=environment, **pipes))
    outputs = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    (folder,) = tmp_path.glob("pretrain/*/")
    assert {out.splitlines()[-1] for out, _ in outputs} == {str(folder)}


def test_settings_of_slurm_that_lightning_refuses_are_said(monkeypatch, capsys):
    job = {"NTASKS": "2", "JOB_NAME": "train", "PROCID": "0", "LOCALID": "0", "NODEID": "0"}
    for name, value in job.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    monkeypatch.delenv("SLURM_NTASKS_PER_NODE", raising=False)
    assert program("predict", "checkpoint=x") == 2
    assert "--ntasks-per-node=2" in the_error(capsys)


def test_a_script_without_srun_has_one_task(tmp_path, monkeypatch):
    job = {"NTASKS": "1", "NTASKS_PER_NODE": "1", "JOB_NAME": "x", "JOB_ID": "7", "NNODES": "1"}
    for name, value in {**job, "PROCID": "0", "LOCALID": "0", "NODEID": "0"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    node = {"_target_": "lightning.Trainer", "accelerator": "cpu", "logger": False}
    wanted = cli.build({**node, "strategy": "ddp", "devices": 2}, _partial_=True)
    with pytest.raises(InputError, match=r"devices=2 .*--ntasks-per-node=1.* with srun"):
        make_trainer(wanted, tmp_path)
    make_trainer(cli.build({**node, "devices": 1}, _partial_=True), tmp_path)


def test_a_demonstration_leaves_other_files_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pretrain").mkdir()
    (tmp_path / "pretrain/model.ckpt").write_text("mine")
    assert program("demo", "folder=.") == 2
    assert "is not empty" in the_error(capsys)
    assert list(files(tmp_path)) == [tmp_path / "pretrain/model.ckpt"]
