"""Modules and networks from checkpoints, of this version and of older ones."""

import copy

import pytest
import torch

from occdetr.errors import InputError
from occdetr.training.checkpoint import read_checkpoint, restore_model
from occdetr.training.full import FullModule
from occdetr.training.instantiate import build_allowed
from occdetr.training.optimizer import OptimizerSettings
from occdetr.training.pretrain import PretrainModule
from occdetr.training.renames import migrate
from occdetr.training.scheduler import Linear
from programs import newest, program, the_error


@pytest.fixture(scope="module")
def raw(runs):
    """The content of a checkpoint of each stage."""
    return {
        stage: torch.load(newest(runs, f"{stage}/*/last.ckpt"), weights_only=True)
        for stage in ("pretrain", "full")
    }


def old_form(content):
    """A checkpoint as version 0.9 wrote it: settings of several kinds at the root."""
    old = copy.deepcopy(content)
    config = old.pop("hyper_parameters")
    warmup = config.pop("scheduler")["warmup_steps"]
    config["module"].pop("scheduler")
    config["optimizer"]["warmup_steps"] = config["module"]["optimizer"]["warmup_steps"] = warmup
    for name, criterion in config.pop("loss").items():
        config[f"{name}_criterion"] = criterion
    if old["occdetr"]["stage"] == "pretrain":
        config["module"]["criterion"] = config["module"].pop("detection_criterion")
    config["data"]["_target_"] = "occdetr.data.datamodule.SyntheticDataModule"
    config |= {"lr": {"pretrain": 1e-3, "full": 1.5e-3}, "backbone": {"weights": None}}
    old["occdetr"]["config"] = config
    return old


@pytest.mark.parametrize("form", ["new", "old"])
@pytest.mark.parametrize(("stage", "kind"), [("pretrain", PretrainModule), ("full", FullModule)])
def test_a_checkpoint_is_all_that_is_needed(stage, kind, form, raw, tmp_path):
    path = tmp_path / "last.ckpt"
    torch.save(raw[stage] if form == "new" else old_form(raw[stage]), path)
    module = kind.load_from_checkpoint(path)
    state = module.state_dict()
    assert state.keys() == raw[stage]["state_dict"].keys()
    assert all(torch.equal(state[name], raw[stage]["state_dict"][name]) for name in state)
    assert module.scheduler_settings == Linear(warmup_steps=100)
    assert module.optimizer_settings.lr == {"pretrain": 1e-3, "full": 1.5e-3}[stage]
    assert module.hparams == raw[stage]["hyper_parameters"]


def test_a_checkpoint_of_the_other_stage_is_refused(runs):
    path = newest(runs, "pretrain/*/last.ckpt")
    with pytest.raises(InputError, match="stage=pretrain: load it with PretrainModule"):
        FullModule.load_from_checkpoint(path)


@pytest.mark.parametrize("change", ["unknown", "missing", "shape"])
def test_a_network_takes_neither_more_nor_less_than_its_weights(change, raw, tmp_path):
    content = copy.deepcopy(raw["full"])
    state, name = content["state_dict"], "model.encoder.level_embed"
    if change == "unknown":
        state["model.encoder.other"] = state[name]
    elif change == "missing":
        del state[name]
    else:
        state[name] = state[name][:1]
    torch.save(content, tmp_path / "last.ckpt")
    for load in (restore_model, FullModule.load_from_checkpoint):
        with pytest.raises(InputError, match=f"1 weights .*{change}, first encoder"):
            load(tmp_path / "last.ckpt")


def test_migration_leaves_todays_configuration_alone(raw):
    config = raw["full"]["hyper_parameters"]
    before = copy.deepcopy(config)
    assert migrate(config) == before
    migrate(old_form(raw["full"])["occdetr"]["config"])
    assert config == before


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "occdetr.models.backbone.torch.hub.load",  # a name inside an allowed module
        "occdetr.models.backbone.Path",
        "occdetr.models.backbone.official_weights",  # a function
        "occdetr.files.write_atomically",
        "occdetr.models",
        "",
        None,
    ],
)
def test_constructors_of_others_are_refused(target, raw, tmp_path):
    with pytest.raises(InputError, match="_target_="):
        build_allowed({"nested": [{"_target_": target, "command": "touch made"}]})
    content = copy.deepcopy(raw["full"])
    content["hyper_parameters"]["model"]["encoder"] = {"_target_": target, "command": "touch made"}
    torch.save(content, tmp_path / "bad.ckpt")
    for load in (restore_model, FullModule.load_from_checkpoint):
        with pytest.raises(InputError, match="_target_="):
            load(tmp_path / "bad.ckpt")


@pytest.mark.parametrize("data", [(), ("data=semantickitti",)])
def test_evaluation_builds_nothing_else_of_a_checkpoints_data(data, raw, tmp_path, capsys):
    content = copy.deepcopy(raw["full"])
    settings = content["hyper_parameters"]["data"]
    touch = {"_target_": "pathlib.Path.touch", "self": {"_target_": "pathlib.Path"}}
    settings |= {"image_size": touch} if data else {"_target_": "pathlib.Path.touch"}
    torch.save(content, tmp_path / "bad.ckpt")
    given = (f"checkpoint={tmp_path}/bad.ckpt", f"hydra.run.dir={tmp_path}/run")
    assert program("evaluate", *given, *data) == 2
    assert "_target_=pathlib.Path" in the_error(capsys)


def test_only_plain_keywords_are_built():
    target = {"_target_": "occdetr.training.optimizer.OptimizerSettings"}
    built = build_allowed({**target, "lr": 2e-4, "lr_factors": {"backbone": 0.1}}, weight_decay=0.0)
    assert built == OptimizerSettings(lr=2e-4, weight_decay=0.0, lr_factors={"backbone": 0.1})
    with pytest.raises(InputError, match="_args_"):
        build_allowed({**target, "_args_": [1]})
    with pytest.raises(InputError, match="unexpected keyword argument 'speed'"):
        build_allowed({**target, "speed": 1})


def test_configuration_of_a_checkpoint_is_todays(raw, tmp_path):
    torch.save(old_form(raw["full"]), tmp_path / "old.ckpt")
    config = read_checkpoint(tmp_path / "old.ckpt").config
    assert set(config["loss"]) == {"detection", "occupancy"}
    assert config["data"]["_target_"] == "occdetr.streets.datamodule.SyntheticDataModule"
    assert not {"lr", "backbone", "detection_criterion"} & set(config)
