"""Lightning's settings in training runs: callbacks, loggers and keywords of the Trainer."""

import importlib.util
import os

import pytest
import torch
from lightning.pytorch.callbacks import EarlyStopping
from lightning.pytorch.loggers import CSVLogger
from omegaconf import OmegaConf

from occdetr.cli.entry import chosen_nodes
from occdetr.errors import InputError
from occdetr.training.callbacks import ValidationRecord, WeightAveraging
from occdetr.training.pictures import PictureLogger
from occdetr.training.precision import CHOICE
from occdetr.training.pretrain import PretrainModule
from occdetr.training.run_checkpoint import LastCheckpoint, RunCheckpoint
from programs import SHORT, STREETS, program, read_json, subprogram, the_error
from recorder import JobRecorder, TrainerRecorder

RECORDER = "trainer.callbacks=[{_target_: recorder.TrainerRecorder}]"


@pytest.fixture
def settings(streets, tmp_path):
    place = f"hydra.run.dir={tmp_path}/run"
    return ("stage=pretrain", *SHORT, *STREETS, f"data.root={streets}", place)


def test_chosen_callbacks_and_loggers_are_used_beside_what_every_run_keeps(settings, tmp_path):
    chosen = ("callbacks=[early_stopping,ema]", "logger=csv", RECORDER, "optimizer.lr=2e-4")
    steps = "trainer.log_every_n_steps=1"
    objective = "+hydra.callbacks.job={_target_: recorder.JobRecorder}"
    assert program("train", *settings, *chosen, steps, objective) == 0
    trainer, folder = TrainerRecorder.trainer, tmp_path / "run"
    kinds = [type(callback) for callback in trainer.callbacks]
    assert {EarlyStopping, WeightAveraging, TrainerRecorder, ValidationRecord} <= set(kinds)
    assert (kinds.count(RunCheckpoint), kinds.count(LastCheckpoint)) == (1, 1)
    assert PictureLogger not in kinds
    assert [type(logger) for logger in trainer.loggers] == [CSVLogger]
    assert sorted(TrainerRecorder.rates) == pytest.approx(
        [0.3 * 2e-4, 2e-4]
    )  # the backbone's first
    names = (folder / "csv/metrics.csv").read_text().splitlines()[0].split(",")
    assert {"loss/total", "loss/auxiliary", "loss_detection/cls", "final/best"} <= set(names)
    given = OmegaConf.load(folder / "csv/hparams.yaml")
    assert given.command_line.startswith("python -m occdetr.train stage=pretrain ")
    assert given.optimizer.lr == 2e-4
    assert not (folder / "tensorboard").exists()
    summary = read_json(folder / "metrics.json")
    assert len(summary["validations"]) == 1
    assert JobRecorder.returned == summary["best"]["value"]
    raw = torch.load(folder / "best.ckpt", weights_only=True)
    assert (folder / "last.ckpt").is_file()
    averaged, current = raw["state_dict"], raw["current_model_state"]
    assert averaged.keys() == current.keys()
    module = PretrainModule.load_from_checkpoint(folder / "best.ckpt")
    assert all(torch.equal(averaged[name], value) for name, value in module.state_dict().items())


def test_the_average_of_weights_leaves_tables_of_classes_alone(settings, tmp_path, monkeypatch):
    """They are buffers, and an average of whole numbers would be rounded down."""
    monkeypatch.setitem(os.environ, CHOICE.format("cpu"), "bf16-mixed")  # as timed before
    steps = ("trainer.max_epochs=3", "trainer.limit_val_batches=0", "callbacks.ema.decay=0.9")
    steps = (*steps, "trainer.precision=auto")
    assert program("train", *settings, "callbacks=ema", RECORDER, *steps) == 0
    assert TrainerRecorder.trainer.precision == "bf16-mixed"
    assert OmegaConf.load(tmp_path / "run/config.yaml").trainer.precision == "bf16-mixed"
    model = TrainerRecorder.trainer.lightning_module.model
    assert model.foreground_classes.tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 18, 19]


def test_a_profiler_reports_and_a_checkpoint_callback_of_the_users_own_works(settings, tmp_path):
    """It monitors what ``best.ckpt`` does, as the user's first own callback often will."""
    own = "{_target_: lightning.pytorch.callbacks.ModelCheckpoint, monitor: val/AP50, mode: max, "
    own = f"+trainer.callbacks=[{own}dirpath: {tmp_path}/own}}]"
    done = subprogram("train", *settings, own, "trainer.profiler=simple")
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "own").glob("*.ckpt"))
    assert {"best.ckpt", "last.ckpt"} <= {file.name for file in (tmp_path / "run").iterdir()}
    assert "FIT Profiler Report" in done.stdout + done.stderr


def test_a_training_without_validation_ends_well(settings, tmp_path, capsys):
    assert program("train", *settings, "trainer.limit_val_batches=0") == 0
    assert "no validation, 1 steps in " in capsys.readouterr().out
    summary = read_json(tmp_path / "run/metrics.json")
    assert summary["best"]["value"] is None
    assert (summary["metrics"], summary["validations"]) == ({}, [])
    assert (tmp_path / "run/last.ckpt").is_file()
    assert not (tmp_path / "run/best.ckpt").exists()


def test_fast_dev_run_saves_nothing(settings, tmp_path, capsys):
    assert program("train", *settings, "+trainer.fast_dev_run=true", "trainer.logger=false") == 0
    assert "nothing is saved" in capsys.readouterr().out
    assert not list((tmp_path / "run").glob("*.ckpt"))


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("trainer.callbacks=[early_stopping]", "trainer.callbacks=['early_stopping']"),
        ("trainer.logger=csv", "trainer.logger=csv"),
        ("trainer.enable_checkpointing=false", "enable_checkpointing"),
        (
            "callbacks=[none_such]",
            "callbacks=none_such: no such option: choose one of charts, checkpoint, default",
        ),
        ("+trainer.no_such_keyword=1", "unexpected keyword argument 'no_such_keyword'"),
        ("callbacks.steps._target_=none.such.Callback", "callbacks.steps: "),
        ("+logger.own=1", "logger.own=1: give a node"),
    ],
)
def test_refused_settings(override, expected, settings, capsys):
    given = f"+{override}" if "enable_checkpointing" in override else override
    assert program("train", *settings, given) == 2
    assert expected in the_error(capsys)


@pytest.mark.parametrize("group", ["callbacks", "logger"])
def test_a_group_holds_nodes_or_null(group):
    given = OmegaConf.create({group: {"own": {"_target_": "a.B"}, "left_out": None}})
    assert list(chosen_nodes(given, group)) == ["own"]
    assert chosen_nodes(OmegaConf.create({group: None}), group) == {}
    for wrong in (1, [1], {"speed": 1}):
        given = OmegaConf.create({group: {"own": wrong}})
        with pytest.raises(
            InputError, match=f"^{group}.own=.*: give a node with _target_, or null"
        ):
            chosen_nodes(given, group)


@pytest.mark.parametrize("package", ["wandb", "mlflow"])
def test_optional_logger_names_its_package(package, settings, capsys):
    if importlib.util.find_spec(package):
        pytest.skip(f"{package} is installed")
    assert program("train", *settings, f"logger={package}") == 2
    line = the_error(capsys)
    assert f"logger.{package}" in line
    assert f"pip install 'occdetr[{package}]'" in line
