"""Choices of the configuration's groups on the command line, before Hydra composes them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from occdetr.errors import InputError

#: Groups of which several options may be chosen together; of others Hydra would mix the settings.
SEVERAL = ("callbacks", "logger", "experiment", "hydra/callbacks")


def check_choices(words: Iterable[str], config_dir: Path) -> None:
    """Raises ``InputError`` for a list of options where one is chosen, and for a list that has
    something else than names."""
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


def _lists(word: str) -> list[list[Any]]:
    """The lists among the values of an override; what cannot be read is left to Hydra."""
    try:
        read = OverridesParser.create().parse_override(word)
    except HydraException:
        return []
    value: Any = read.value()
    values = value.list if read.is_sweep_override() else [value]
    return [each for each in values if isinstance(each, list)]
