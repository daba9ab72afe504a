"""Choices of the configuration's groups on the command line, before Hydra composes them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from occdetr.errors import InputError

#: Groups of which several options may be chosen together; of others Hydra would mix the settings.
SEVERAL = ("callbacks", "logger", "experiment", "hydra/callbacks")
#: Those whose options are nodes, each with a name of its own.
NAMED_NODES = ("callbacks", "logger")


def check_choices(words: Iterable[str], config_dir: Path) -> None:
    """Raises ``InputError`` for a list of options where one is chosen, for a list of something else
    than names, and for options that would replace each other."""
    for word in words:
        key, _, text = word.lstrip("+").partition("=")
        group = key.split("@")[0]
        if text[:1] != "[" or not (config_dir / group).is_dir() or group == "hydra":
            continue
        for options in _lists(word):
            if group not in SEVERAL:
                raise InputError(
                    f"{key}={text}: takes one option: give {key}=<name>, or several runs with "
                    f"-m {key}=<name>,<name>"
                )
            if not all(isinstance(option, str) for option in options):
                raise InputError(
                    f"{key}={text}: takes names of options: give {key}=[<name>,<name>]"
                )
            if group in NAMED_NODES:
                _check_nodes(f"{key}={text}", config_dir / group, options)


def _check_nodes(setting: str, folder: Path, options: list[str]) -> None:
    """Raises ``InputError`` if two options set the same node: the last one would replace it."""
    chosen: dict[str, str] = {}
    for option in options:
        file = folder / f"{option}.yaml"
        if not file.is_file():  # Hydra lists those that there are
            continue
        for node in yaml.safe_load(file.read_text(encoding="utf-8")) or {}:
            other = chosen.setdefault(node, option)
            if node != "defaults" and other != option:
                raise InputError(f"{setting}: {other} and {option} both set {node}: keep one")


def _lists(word: str) -> list[list[Any]]:
    """The lists among the values of an override; what cannot be read is left to Hydra."""
    try:
        read = OverridesParser.create().parse_override(word)
    except HydraException:
        return []
    value: Any = read.value()
    values = value.list if read.is_sweep_override() else [value]
    return [each for each in values if isinstance(each, list)]
