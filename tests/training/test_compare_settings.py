"""Which settings may change when a run is resumed."""

import copy
import functools
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from model_factory import tiny_config
from occdetr.cli.entry import compose, plain
from occdetr.errors import InputError
from occdetr.training.compare_settings import (
    changes,
    check_same_model,
    differences,
    fixed_differences,
    source_differences,
)
from occdetr.training.renames import migrate

OLD_RUN = Path(__file__).parent / "run_of_8caa945.yaml"


@functools.cache
def composed(stage, *choices):
    return tiny_config(stage=stage, overrides=choices)


def settings(*overrides, stage="pretrain"):
    """The configuration with overrides; composed anew for a choice of a group only."""
    choices = [text for text in overrides if "." not in text.split("=")[0] and "seed" not in text]
    config = copy.deepcopy(composed(stage, *choices))
    for text in overrides:
        if text not in choices:
            key, _, value = text.partition("=")
            OmegaConf.update(config, key, yaml.safe_load(value))
    return plain(config)


@pytest.fixture(scope="module")
def saved():
    return settings()


@pytest.mark.parametrize(
    "override",
    [
        *("seed=1", "partition=all_background", "attention.hidden_dim=64", "data.seed=3"),
        *("data.stride=1", "data.num_train=7", "data.objects.ray_stride=1"),
        *("optimizer=adamw", "optimizer.matrix_lr=null", "scheduler=cosine"),
        *("query_selection=two_stage", "callbacks=[default,ema]", "model.fusion.score_threshold=1"),
    ],
)
def test_what_would_be_another_run_is_refused(override, saved):
    assert fixed_differences(saved, settings(override))


@pytest.mark.parametrize(
    ("override", "change"),
    [
        ("optimizer.lr=0.0002", ("optimizer.lr", 1e-3, 2e-4)),
        ("optimizer.weight_decay=0", ("optimizer.weight_decay", 0.01, 0)),
        ("scheduler.warmup_steps=3", ("scheduler.warmup_steps", 100, 3)),
        ("trainer.max_epochs=7", ("trainer.max_epochs", 50, 7)),
        ("data.batch_size=8", ("data.batch_size", 2, 8)),
    ],
)
def test_what_may_change_is_named_once(override, change, saved):
    config = settings(override)
    assert fixed_differences(saved, config) == []
    assert changes(saved, config) == [change]


def test_another_average_of_the_weights_is_named():
    ema, mean = settings("callbacks=[default,ema]"), settings("callbacks=[default,mean]")
    assert fixed_differences(ema, mean) == []
    assert changes(ema, mean) == [("callbacks.ema.age", 0.1, 0.5)]
    ema["callbacks"]["step"] = {"_target_": "x.Monitor", "age": 7}  # averages nothing
    assert changes(ema, mean) == [("callbacks.ema.age", 0.1, 0.5)]


@pytest.mark.parametrize(
    "override",
    [
        *("data.root=elsewhere", "data.num_workers=0", "logger=csv"),
        *("trainer=ddp", "callbacks=[]", "resume=auto"),
    ],
)
def test_where_and_how_a_run_runs_is_not_compared(override, saved):
    assert differences(saved, settings(override)) == []


def test_a_resumed_run_keeps_the_precision_that_auto_has_taken(saved):
    taken, left_open = settings("trainer.precision=bf16-mixed"), settings("trainer.precision=auto")
    assert differences(taken, left_open) == []
    assert changes(taken, saved) == [("trainer.precision", "bf16-mixed", "32-true")]
    assert changes(saved, taken) == [("trainer.precision", "32-true", "bf16-mixed")]


def test_weights_come_from_the_same_network_partition_seed_and_data(saved):
    assert source_differences(saved, settings(stage="full")) == []
    assert source_differences(saved, settings("optimizer.lr=5", stage="full")) == []
    others = (
        "seed=1",
        "data.root=x",
        "data.extra_roots=[x]",
        "data.stride=1",
        "attention.num_points=3",
    )
    for override in (*others, "model.encoder.finest_every=2"):
        assert source_differences(saved, settings(override, stage="full")), override
    assert source_differences(saved, settings("partition=all_background", stage="full"))


@pytest.mark.parametrize("model", ["small", "paper"])
def test_a_run_from_before_the_group_of_backbones_can_be_resumed(model):
    """Its network is the same, though its configuration has no settings of the group."""
    config = plain(compose("train", [f"model={model}"]))
    old = copy.deepcopy(config)
    for name in ("backbone_channels", "backbone_rates", "backbone_by_adamw"):
        del old[name]
    for optimizer in (old["optimizer"], old["module"]["optimizer"]):
        optimizer.pop("adamw_parts", None)
    old["model"]["backbone"]["_target_"] = "occdetr.models.backbone.ResNet"
    assert fixed_differences(migrate(old), config) == []


def test_a_run_of_an_older_version_can_be_resumed():
    """A setting that is new has the value of before in ``renames.ADDED``; a default that is
    another one is named, and can be given."""
    saved = yaml.safe_load(OLD_RUN.read_text(encoding="utf-8"))
    given = ["stage=full", "experiment=demo"]
    changed = "model.occupancy_decoder.background.convolution_dim"
    found = fixed_differences(migrate(saved), plain(compose("train", given)))
    assert found == [(changed, None, 16)]
    assert not fixed_differences(
        migrate(saved), plain(compose("train", [*given, f"{changed}=null"]))
    )


def test_parts_without_muon_cannot_change():
    config = plain(compose("train", []))
    other = plain(compose("train", ["optimizer.adamw_parts=[]"]))
    paths = [path for path, *_ in fixed_differences(config, other)]
    assert "optimizer.adamw_parts" in paths


def test_weights_of_another_image_size_are_taken_and_of_another_network_refused(saved):
    check_same_model(saved, settings("image_size=[64,416]"), "init_from=a")
    with pytest.raises(InputError, match=r"init_from=a: it was trained with attention\.hidden_dim"):
        check_same_model(saved, settings("attention.hidden_dim=64"), "init_from=a")
