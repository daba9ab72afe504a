"""The settings by which the runs of a sweep are compared."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

from hydra.core.hydra_config import HydraConfig

from occdetr.training.compare_settings import PLACE, select

#: Groups whose choice every run names, and settings whose value it gives.
GROUPS = ("stage", "model", "partition", "query_selection", "data", "optimizer")
SETTINGS = ("optimizer.lr", "data.batch_size", "trainer.max_epochs", "seed")
#: Settings that say where and how a run runs, but for those that change its result.
_KEPT = ("init_from", "callbacks*")
_LEFT_OUT = ("hydra.*", "trainer", *(name for name in PLACE if name not in _KEPT))


def hyperparameters(settings: Mapping[str, Any]) -> dict[str, str | float]:
    """What tells this run of Hydra from others, by name: ``GROUPS``, ``SETTINGS``, and whatever
    else was given on the command line, but for places, devices and logs.

    ``settings`` are the run's, with their interpolations resolved. Groups have their option.
    """
    hydra: Any = HydraConfig.get()
    return compared(settings, hydra.runtime.choices, hydra.overrides.task)


def compared(
    settings: Mapping[str, Any], choices: Mapping[str, Any], overrides: Iterable[str]
) -> dict[str, str | float]:
    """``hyperparameters`` of a run with these choices of groups and this command line."""
    given = (re.match(r"[+~]*([\w./-]+)", text) for text in overrides)
    typed = [match[1].replace("/", ".") for match in given if match]
    typed = [name for name in typed if not any(fnmatchcase(name, each) for each in _LEFT_OUT)]
    groups = {name.replace("/", "."): choice for name, choice in choices.items()}
    names = dict.fromkeys([*GROUPS, *SETTINGS, *typed])
    values = {name: groups.get(name, select(settings, name)) for name in names}
    return {name: _plain(value) for name, value in values.items()}


def _plain(value: Any) -> str | float:
    """A number, or a text; TensorBoard would count truth values as numbers."""
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) else str(value)
