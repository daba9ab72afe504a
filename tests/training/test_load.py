"""Modules and networks from checkpoints, of this version and of older ones."""

import copy
import functools
import sys
import zipfile
from pathlib import Path

import pytest
import torch

from model_factory import tiny_model
from occdetr.errors import InputError
from occdetr.models.resnet import ResNet
from occdetr.training.checkpoint import load_initial, read_checkpoint, restore_model
from occdetr.training.find_checkpoint import check_resumable
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
    del config["model"]["encoder"]["finest_every"]
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


def test_a_setting_that_was_added_has_the_value_of_before(raw):
    old = old_form(raw["full"])["occdetr"]["config"]
    assert migrate(old)["model"]["encoder"]["finest_every"] == 1


def test_the_backbone_of_older_checkpoints_has_moved():
    old = {"model": {"backbone": {"_target_": "occdetr.models.backbone.ResNet", "depth": 18}}}
    backbone = build_allowed(migrate(old)["model"]["backbone"])
    assert isinstance(backbone, ResNet)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "occdetr.models.pretrained.torch.hub.load",  # a name inside an allowed module
        "occdetr.models.pretrained.Path",
        "occdetr.models.resnet.imagenet_state",  # a function
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


def nested(depth):
    node = {}
    for _ in range(depth):
        node = {"a": node}
    return node


def shared(depth):
    """A node of 2 ** depth entries in little memory."""
    node = [1.0]
    for _ in range(depth):
        node = [node, node]
    return node


class Reduced:
    def __reduce__(self):
        return (Path.touch, (Path("made"),))


def change(content, path, value):
    """A copy of a checkpoint's content with another value at ``a.b.c``."""
    content = copy.deepcopy(content)
    if path.startswith("state_dict."):  # the names of weights have points
        content["state_dict"][path.removeprefix("state_dict.")] = value
        return content
    *parents, last = path.split(".")
    functools.reduce(lambda node, key: node[key], parents, content)[last] = value
    return content


TOUCH = {"_target_": "pathlib.Path.touch", "self": {"_target_": "pathlib.Path", "_args_": ["made"]}}
PARTIAL = {"_target_": "occdetr.losses.matcher.HungarianMatcher", "_partial_": True}
MODEL, MODULE, DATA = (f"hyper_parameters.{name}" for name in ("model", "module", "data"))
WEIGHT = "model.encoder.level_embed"
HOSTILE = {
    "code in the model": (f"{MODEL}.encoder", TOUCH, "_target_=pathlib.Path.touch"),
    "code deep in the model": (f"{MODEL}.detector.a", [{"b": TOUCH}], "_target_=pathlib.Path"),
    "code as the model": (MODEL, TOUCH, "_target_=pathlib.Path.touch"),
    "code in the module": (f"{MODULE}.scheduler", TOUCH, "_target_=pathlib.Path.touch"),
    "code as the module": (MODULE, TOUCH, "_target_=pathlib.Path.touch"),
    "code in the data": (f"{DATA}.objects", TOUCH, "_target_=pathlib.Path.touch"),
    "code behind a class": (
        *(f"{MODEL}.encoder", {"_target_": "occdetr.models.backbone.torch.load", "f": "x"}),
        "_target_=occdetr.models.backbone.torch.load",
    ),
    "partial": (f"{MODEL}.encoder", {**PARTIAL}, "_partial_ is not supported"),
    "a reference": (f"{DATA}.root", "${oc.env:HOME}", "refers to ${oc.env:HOME}"),
    "a reference in a key": (f"{MODEL}.${{x}}", 1, "refers to ${x}"),
    "deep": (f"{MODEL}.encoder", nested(400), "nested too deeply"),
    "shared": (f"{MODEL}.encoder", shared(40), "nested too deeply or too long"),
    "large": (f"{MODEL}.encoder.attention.hidden_dim", 2**30, "larger network than its weights"),
    "many": (f"{MODEL}.encoder.num_layers", 10**9, "larger network than its weights"),
    "long": (f"{MODEL}.encoder.attention.num_levels", 10**9, "larger network than its weights"),
    "a word": (f"{MODEL}.encoder.attention.hidden_dim", "wide", "checkpoint="),
    "a list": (f"{MODEL}.image_size", [], "checkpoint="),
    "no dictionary": (MODEL, 3, "has no 'model'"),
    "no configuration": ("hyper_parameters", [1], "checkpoint="),
    "no stage": ("occdetr", {"version": "1"}, "was not written by occdetr.train"),
    "no name": ("occdetr", "full", "was not written by occdetr.train"),
    "no weights": ("state_dict", {}, "checkpoint="),
    "no tensors": ("state_dict", {"model.a": 3, 4: "x"}, "checkpoint="),
    "another weight": ("state_dict", [1, 2], "was not written by occdetr.train"),
    "a view without end": (f"state_dict.{WEIGHT}", torch.zeros(1).expand(2**40), "fewer weights"),
    "sparse": (f"state_dict.{WEIGHT}", torch.eye(3).to_sparse(), "no plain array"),
    "no values": (f"state_dict.{WEIGHT}", torch.empty(3, device="meta"), "no plain array"),
    "another type": (f"state_dict.{WEIGHT}", torch.zeros(3, dtype=torch.complex64), "no plain"),
    "eight bits": (f"state_dict.{WEIGHT}", torch.zeros(3).to(torch.float8_e5m2), "no plain"),
    "no number of steps": ("global_step", "many", "was not written by occdetr.train"),
    "a tensor": (f"{MODEL}.encoder", torch.zeros(2), "has a Tensor"),
    "an object": ("pytorch-lightning_version", Reduced(), "not a readable checkpoint"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_checkpoint_is_refused_in_one_line(name, raw, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path, value, fact = HOSTILE[name]
    torch.save(change(raw["full"], path, value), "bad.ckpt")
    if name in ("code in the data", "code in the module", "many"):
        assert program("evaluate", "checkpoint=bad.ckpt", "hydra.run.dir=run", "trainer=cpu") == 2
        line = the_error(capsys)
    else:
        with pytest.raises(InputError) as error:
            FullModule.load_from_checkpoint("bad.ckpt")
        line = str(error.value)
    assert fact in line
    assert len(line) < 400
    assert [file.name for file in tmp_path.rglob("*") if file.is_file()] == ["bad.ckpt"]


def test_a_compressed_checkpoint_is_refused(raw, tmp_path):
    torch.save(raw["full"], tmp_path / "good.ckpt")
    with (
        zipfile.ZipFile(tmp_path / "good.ckpt") as good,
        zipfile.ZipFile(tmp_path / "bad.ckpt", "w", zipfile.ZIP_DEFLATED) as bad,
    ):
        for entry in good.namelist():
            bad.writestr(entry, good.read(entry))
    with pytest.raises(InputError, match="not a readable checkpoint"):
        restore_model(tmp_path / "bad.ckpt")


def test_a_class_of_the_users_own_is_built_if_its_module_is_allowed(raw, tmp_path, monkeypatch):
    text = (
        "from occdetr.models.encoder import DeformableEncoder\nclass Own(DeformableEncoder): pass"
    )
    (tmp_path / "own_models.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    content = change(raw["full"], f"{MODEL}.encoder._target_", "own_models.Own")
    torch.save(content, tmp_path / "own.ckpt")
    with pytest.raises(InputError, match=r"allow=\[own_models\]"):
        restore_model(tmp_path / "own.ckpt")
    assert "own_models" not in sys.modules
    model, _ = restore_model(tmp_path / "own.ckpt", allow=["own_models"])
    assert type(model.encoder).__name__ == "Own"
    module = FullModule.load_from_checkpoint(tmp_path / "own.ckpt", allow=["own_models"])
    assert type(module.model.encoder).__name__ == "Own"


@pytest.mark.parametrize("part", ["loops", "optimizer_states", "lr_schedulers", "callbacks"])
def test_a_run_is_not_resumed_from_weights_alone(part, raw, tmp_path):
    torch.save({**raw["full"], part: {}}, tmp_path / "weights.ckpt")
    checkpoint = read_checkpoint(tmp_path / "weights.ckpt")
    with pytest.raises(InputError, match=r"no state of an optimizer: .* init_from="):
        check_resumable(checkpoint, checkpoint.config, "resume=x")


def test_a_part_that_pretraining_trains_is_loaded_as_a_whole(raw, tmp_path):
    state = dict(raw["full"]["state_dict"])
    del state["model.backbone.stem.0.weight"]
    torch.save({**raw["full"], "state_dict": state}, tmp_path / "partial.ckpt")
    with pytest.raises(InputError, match=r"lacks 1 weights of the backbone, first backbone\.stem"):
        load_initial(tiny_model(), read_checkpoint(tmp_path / "partial.ckpt"))
