"""Every combination of the configuration composes, and builds what it describes."""

import importlib
import subprocess
import sys
import zipfile
from itertools import product
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from documents import commands, read
from occdetr.cli import entry as cli
from occdetr.cli.schema import check_types
from occdetr.cli.user_errors import options_of
from occdetr.errors import InputError
from occdetr.study.plan import read_study
from occdetr.training.scheduler import Cosine

REPOSITORY = Path(__file__).parents[1]
MODELS, PARTITIONS = ("tiny", "small", "paper"), ("mixed", "all_foreground", "all_background")
ENTRIES = (
    *("train", "evaluate", "predict", "export", "prepare", "visualize", "benchmark"),
    *("demo", "study", "results", "summarize"),
)


def build_on_meta(config):
    """The network without its memory."""
    config.model.backbone.weights = None
    with torch.device("meta"):
        return cli.build(config.model)


@pytest.mark.parametrize(
    ("stage", "data", "partition", "model"),
    product(("pretrain", "full"), ("synthetic", "semantickitti"), PARTITIONS, MODELS),
)
def test_each_combination_composes_and_instantiates(stage, data, partition, model):
    choices = [f"stage={stage}", f"data={data}", f"partition={partition}", f"model={model}"]
    config = cli.compose("train", choices)
    OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    network = build_on_meta(config)
    assert config.model_name == model
    assert network.image_size == tuple(config.image_size)
    assert len(network.foreground_classes) == len(config.foreground_classes)
    datamodule = cli.build(config.data)
    assert datamodule.network.image_size == network.image_size
    assert datamodule.labels.settings.classes == tuple(config.foreground_classes)
    if stage == "pretrain" and partition == "all_background":
        with pytest.raises(Exception, match="no objects to detect") as caught:
            cli.build(config.module, model=network)
        assert isinstance(caught.value.__cause__, InputError)
    else:
        module = cli.build(config.module, model=network)
        assert module.model is network


@pytest.mark.parametrize("selection", ["early_matching", "two_stage", "mixed"])
def test_each_query_selection_builds(selection):
    config = cli.compose("train", [f"query_selection={selection}", "stage=pretrain"])
    module = cli.build(config.module, model=build_on_meta(config))
    assert module.early_matching_share == float(selection == "early_matching")


def test_optimizer_scheduler_and_loss_are_groups():
    given = ["scheduler=cosine", "optimizer.lr=2e-4", "loss.detection.weights.cls=1"]
    config = cli.compose("train", ["stage=full", *given])
    module = cli.build(config.module, model=build_on_meta(config))
    assert module.scheduler_settings == Cosine(warmup_steps=100)
    assert module.optimizer_settings.lr == 2e-4
    assert module.optimizer_settings.lr_factors["backbone"] == 0.1  # of the stage, as before
    assert module.detection_criterion.weights["cls"] == 1


@pytest.mark.parametrize(
    ("given", "lr", "matrix_lr"),
    [
        (["stage=pretrain"], 1e-3, 0.01),
        (["stage=full"], 1.5e-3, 0.01),
        (["stage=full", "model=paper"], 1e-4, None),
        (["stage=full", "model=paper", "optimizer=muon"], 1e-3, 0.01),
    ],
)
def test_the_optimizer_is_the_stages_then_the_models_then_the_users(given, lr, matrix_lr):
    optimizer = cli.compose("train", given).optimizer
    assert (optimizer.lr, optimizer.matrix_lr) == (lr, matrix_lr)


@pytest.mark.parametrize("trainer", ["auto", "cpu", "gpu", "ddp"])
def test_each_trainer_composes(trainer):
    config = cli.compose("train", [f"trainer={trainer}"])
    assert config.trainer.use_distributed_sampler is False  # it would count frames twice
    assert config.trainer.max_epochs == 50


@pytest.mark.parametrize("experiment", options_of(cli.config_dir() / "experiment"))
def test_each_experiment_composes_and_instantiates(experiment):
    study, _, arm = experiment.partition("/")
    partition = {"partition": arm, "paper": "paper"}.get(study, "mixed")
    for stage in ("pretrain", "full"):
        config = cli.compose("train", [f"experiment={experiment}", f"stage={stage}"])
        assert (config.partition_name, config.stage_name) == (partition, stage)
        network, datamodule = build_on_meta(config), cli.build(config.data)
        assert datamodule.network.image_size == network.image_size
        assert datamodule.labels.settings.classes == tuple(config.foreground_classes)
        assert len(network.foreground_classes) == len(config.foreground_classes)
        assert (network.detector is not None) == (partition != "all_background")
        assert (network.mask_head is not None) == (partition != "all_foreground")
        if stage == "full" or network.detector is not None:
            OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            assert isinstance(config.trainer.max_epochs, int)
            assert config.trainer.max_epochs > 0
            assert cli.build(config.module, model=network).model is network


@pytest.mark.parametrize("experiment", options_of(cli.config_dir() / "experiment"))
def test_the_optimizer_and_the_callbacks_of_an_experiment_can_be_replaced(experiment):
    """What the experiment sets belongs to its own choice, and not to another one of the group."""
    other = ["stage=full", "optimizer=adamw", "callbacks=[default,early_stopping]"]
    config, plain = (
        cli.compose("train", [*other, *given]) for given in ([f"experiment={experiment}"], [])
    )
    if experiment != "partition/all_background":  # rates of an arm that differs in them alone
        assert config.optimizer == plain.optimizer
    nodes = cli.chosen_nodes(config, "callbacks")
    assert set(nodes) == set(cli.chosen_nodes(plain, "callbacks"))


@pytest.mark.parametrize("entry", ["prepare", "visualize"])
@pytest.mark.parametrize("data", ["synthetic", "synthetic_demo", "semantickitti"])
@pytest.mark.parametrize("partition", PARTITIONS)
def test_labels_are_configured_without_a_network(entry, data, partition):
    config = cli.compose(entry, [f"data={data}", f"partition={partition}"])
    datamodule = cli.build(config.data)
    assert datamodule.network is None
    assert datamodule.labels.settings.classes == tuple(config.foreground_classes)
    assert "image_size" not in config


def test_each_arm_of_each_study_is_an_experiment():
    experiments = options_of(cli.config_dir() / "experiment")
    for study in ("convergence", "partition", "real"):
        arms = {f"{study}/{arm}" for arm in read_study(study)["arms"]}
        assert arms == {name for name in experiments if name.startswith(f"{study}/")}


@pytest.mark.parametrize("entry", ENTRIES)
def test_each_entry_point_composes(entry):
    assert "seed" in cli.compose(entry) or entry in ("demo", "study", "results", "summarize")


def test_configuration_is_found_from_another_folder(tmp_path):
    code = "from occdetr.cli.entry import compose; print(compose('train').model_name)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "tiny"


@pytest.mark.parametrize(("entry", "overrides"), [*commands(read(REPOSITORY / "README.md"))])
def test_each_command_of_the_readme_takes_effect(entry, overrides):
    """The program exists, and finds each setting in its configuration as the README gives it."""
    module = {"study": "study.plan", "results": "study.results"}.get(entry, entry)
    assert callable(importlib.import_module(f"occdetr.{module}").main)
    with initialize_config_dir(str(cli.config_dir()), version_base="1.3"):
        config = compose(entry, overrides, return_hydra_config=True)
    check_types(config)
    for override in OverridesParser.create().parse_overrides(overrides):
        key, value = override.key_or_group, override.value()
        if isinstance(value, list) and (cli.config_dir() / key).is_dir():
            assert {*value} - {"default"} <= {*config[key]}  # a list of options, a node each
            continue
        choices = config.hydra.runtime.choices
        assert (choices[key] if key in choices else OmegaConf.select(config, key)) == value


@pytest.mark.slow
def test_a_wheel_carries_the_configuration(tmp_path):
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(tmp_path)]
    subprocess.run([*build, str(REPOSITORY)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    packed = set(zipfile.ZipFile(wheel).namelist())
    conf = REPOSITORY / "conf"
    files = {f"occdetr/conf/{file.relative_to(conf)}" for file in conf.rglob("*.yaml")}
    assert files <= packed
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    code = "import occdetr.cli.entry as c; print(c.config_dir(), c.compose('train').model_name)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True,
        env={"PYTHONPATH": str(tmp_path / "installed"), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    assert done.stdout.split() == [str(tmp_path / "installed" / "occdetr" / "conf"), "tiny"]
