"""Settings of a run that Lightning finds out late or never; checked before any data is made."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from lightning.pytorch.accelerators import AcceleratorRegistry
from lightning.pytorch.strategies import StrategyRegistry

from occdetr.classes import CLASS_NAMES
from occdetr.errors import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, InputError, Range, check_range
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.stage import StageModule

#: Keywords that the Trainer takes with values that stop a run in the middle or have no effect.
RANGES = {
    **dict.fromkeys(("accumulate_grad_batches", "check_val_every_n_epoch"), COUNT),
    **dict.fromkeys(("log_every_n_steps", "gradient_clip_val", "min_epochs"), NOT_NEGATIVE),
    **dict.fromkeys(("min_steps", "reload_dataloaders_every_n_epochs"), NOT_NEGATIVE),
    "num_nodes": Range(1, 2**14),
    "num_sanity_val_steps": Range(-1),
    "val_check_interval": POSITIVE,
}
#: A share of the batches, or a number of them.
PARTS_OF_DATA = (
    *("limit_train_batches", "limit_val_batches", "limit_test_batches", "limit_predict_batches"),
    "overfit_batches",
)


def check_trainer(keywords: Mapping[str, Any]) -> None:
    """Raises ``InputError`` on keywords of ``lightning.Trainer`` out of range."""
    _check_names(keywords)
    for name, limits in RANGES.items():
        value = keywords.get(name)
        if isinstance(value, (int, float)):  # an interval may also be a duration
            check_range(f"trainer.{name}", value, limits)
    for name in PARTS_OF_DATA:
        value = keywords.get(name)
        part = isinstance(value, float) and not value.is_integer()
        check_range(f"trainer.{name}", value, SHARE if part else NOT_NEGATIVE)
    if keywords.get("use_distributed_sampler"):
        raise InputError(
            "trainer.use_distributed_sampler=true: the data module gives each rank its frames "
            "already, and Lightning would leave out some of them: leave it false"
        )
    for name in ("max_epochs", "max_steps"):  # -1: no end
        if keywords.get(name) != -1:
            check_range(f"trainer.{name}", keywords.get(name), COUNT)


def _check_names(keywords: Mapping[str, Any]) -> None:
    """Raises ``InputError`` for a name, or a number or list in its place, that Lightning does not
    know. An object, which is a node with ``_target_``, may be anything."""
    choices = {
        "accelerator": ("auto", "gpu", *AcceleratorRegistry.available_accelerators()),
        "strategy": ("auto", *StrategyRegistry.available_strategies()),
        "profiler": (None, "simple", "advanced", "pytorch"),
    }
    for name, known in choices.items():
        value = keywords.get(name, known[0])
        if value not in known and isinstance(value, (str, int, float, list)):
            names = ", ".join("null" if each is None else each for each in known)
            raise InputError(f"trainer.{name}={value}: choose one of {names}")


def explain_trainer(keywords: Mapping[str, Any], message: str) -> str:
    """What Lightning refuses, as one line that names the settings which its message is about."""
    named = [
        f"trainer.{name}={value}"
        for name, value in keywords.items()
        if isinstance(value, (str, int, float))
        and (name in message or re.search(rf"\b{re.escape(str(value))}\b", message))
    ]
    return f"{', '.join(named) or 'trainer'}: {' '.join(message.split())}: change that setting"


def check_training(keywords: Mapping[str, Any]) -> None:
    """Raises ``InputError`` if a training would take no step, or would have no end."""
    if keywords.get("limit_train_batches") == 0:
        raise InputError("trainer.limit_train_batches=0: no step would be taken: give more or null")
    endless = keywords.get("max_epochs") == -1 and keywords.get("max_steps", -1) == -1
    if endless and not keywords.get("fast_dev_run"):
        raise InputError(
            "trainer.max_epochs=-1: the schedule needs an end: give a number, or trainer.max_steps"
        )


def classes_without_a_part(model: OccupancyDETR) -> str | None:
    """A warning that names the classes which no part of the network can predict."""
    own = [] if model.detector is None else model.detector.classes
    predicted = {*own, *model.fusion.classes}
    names = [name for i, name in enumerate(CLASS_NAMES) if i and i not in predicted]
    if not names:
        return None
    return (
        f"{', '.join(names)}: in neither foreground_classes nor mask_classes: never predicted, and "
        "trained as empty space: add them to one of the two"
    )


def check_monitors(module: StageModule, monitor: str, callbacks: Mapping[str, Any]) -> None:
    """Raises ``InputError`` if a figure to watch is none that validations of the stage log.

    ``callbacks``: settings by name. Theirs may also be a figure of training steps, which has a
    prefix other than ``val``, as in ``loss/total``.
    """
    figures, watched = module.figure_names(), {"monitor": monitor}
    for name, settings in callbacks.items():
        own = str(settings.get("monitor") or monitor)
        if own.startswith("val") or "/" not in own:
            watched[f"callbacks.{name}.monitor"] = own
    for setting, name in watched.items():
        if name not in figures:
            shown = ", ".join(figure for figure in figures if figure.startswith("val/"))
            raise InputError(f"{setting}={name}: stage={module.stage} logs {shown}: choose one")


def check_input(model: OccupancyDETR, datamodule: Any) -> None:
    """Raises ``InputError`` if the data module's ``NetworkInput`` or object classes are not the
    network's, which both follow the same settings."""
    network, labels = getattr(datamodule, "network", None), getattr(datamodule, "labels", None)
    pairs = {}
    if network is not None:
        pairs["image_size"] = ("image_size", network.image_size, model.image_size)
    if network is not None and model.detector is not None:
        layout = model.detector.selection.layout
        pairs["strides"] = ("strides", network.strides, layout.strides)
        pairs["roi_scale"] = ("roi_scale", [network.roi_scale], [layout.scale])
    if labels is not None and model.detector is not None:
        classes = sorted(labels.settings.classes), sorted(model.detector.classes)
        pairs["objects.classes"] = ("foreground_classes", *classes)
    for name, (source, given, own) in pairs.items():
        if list(given) != list(own):
            raise InputError(
                f"data.{name}={list(given)}: the network has {list(own)}: set {source}, which "
                "both follow"
            )
