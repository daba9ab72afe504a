"""The data set of a program that runs a checkpoint: the one that the user names, or its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from occdetr.cli import entry as cli
from occdetr.errors import InputError
from occdetr.training.instantiate import allowed_class, build_allowed, targets_of
from occdetr.training.released import NETWORK_SETTINGS

#: Settings of a training's data that are not taken over from a checkpoint.
_OF_TRAINING = ("allow_partial", "repeats", "extra_roots")


def checkpoint_data(config: DictConfig, trained: Any, keywords: Mapping[str, Any]) -> Any:
    """The data module that ``config`` names, else the checkpoint's, for its network; with further
    ``keywords``. ``trained`` is the checkpoint's configuration."""
    asked: Any = OmegaConf.to_container(config.data)
    given = {key: asked[key] for key in asked if not OmegaConf.is_missing(config.data, key)}
    chosen = "_target_" in given
    if not chosen:  # what the training may leave out, this program may not unless it is asked to
        own = {key: value for key, value in trained["data"].items() if key not in _OF_TRAINING}
        given = {**own, **given}
        if "_target_" not in own:
            raise InputError(
                f"checkpoint={config.checkpoint}: a released model has no data set: give "
                "data=synthetic_demo, or data=semantickitti data.root=..."
            )
    given.update({key: trained["data"][key] for key in NETWORK_SETTINGS})
    # what was asked for refers to settings of the partition
    merged = OmegaConf.create({**trained, "seed": config.seed, "data": {**given, **keywords}})
    data = cli.plain(merged.data)
    if not chosen:
        return build_allowed(data, cli.plain(config.allow))
    for target in targets_of(data) - targets_of(asked):
        allowed_class(target, cli.plain(config.allow))  # it is from the checkpoint
    return cli.build(data)
