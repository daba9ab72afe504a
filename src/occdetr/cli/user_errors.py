"""Mistakes in settings and files, each told in one line that names it and the mend."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    MissingMandatoryValue,
    OmegaConfBaseException,
    ReadonlyConfigError,
)
from yaml import YAMLError

from occdetr.errors import InputError

#: Composes the entry point's configuration from overrides.
Compose = Callable[[list[str]], DictConfig]

#: Settings whose kind of value may differ from that of their default.
_ANY_KIND = ("trainer.devices", "trainer.precision", "trainer.strategy", "trainer.profiler")


def explain(
    error: BaseException, overrides: Sequence[str], config_dir: Path, compose: Compose
) -> str | None:
    """One line for an error that a person can mend; None for a defect of the program."""
    for cause in _causes(error):
        if isinstance(cause, InputError):
            return _without_worker(str(cause))
    if isinstance(error, MissingConfigException):
        return _unknown_option(error, config_dir)
    if isinstance(error, OverrideParseException):
        reason = str(error).splitlines()[0]
        return f"{error.override!r} cannot be read ({reason}): write settings as key=value"
    if isinstance(error, ConfigCompositionException):
        unknown = re.search(r"Could not override '([^']*)'", str(error))
        if unknown:
            return _unknown_setting(unknown[1], overrides, config_dir, compose)
        return _join(error)
    if isinstance(error, InstantiationException):
        return _bad_instance(error)
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} is not set: give it, as in {error.full_key}=<value>"
    if isinstance(error, (ReadonlyConfigError, ConfigAttributeError, ConfigKeyError)):
        return None  # our own code asked for what is not there
    if isinstance(error, (OmegaConfBaseException, HydraException, YAMLError)):
        return _join(error)
    if isinstance(error, ValueError) and str(error).startswith("Config group override"):
        return f"{' '.join(overrides)}: a group takes the name of an option, as in model=tiny"
    if isinstance(error, torch.OutOfMemoryError):
        return "out of GPU memory: lower data.batch_size, or take a smaller model"
    if isinstance(
        error, (FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError)
    ):
        return f"{error.filename or error}: {(error.strerror or 'no such file').lower()}: " + (
            "check the path"
        )
    return None


def _causes(error: BaseException) -> Iterable[BaseException]:
    current: BaseException | None = error
    while current is not None:
        yield current
        current = current.__cause__


def _without_worker(message: str) -> str:
    """The message itself, of an error that crossed from a data worker with its traceback."""
    lines = [line for line in message.splitlines() if line.strip()]
    if message.startswith("Caught ") and len(lines) > 1:
        return lines[-1].split("InputError: ", 1)[-1]
    return " ".join(lines)


def _join(error: BaseException) -> str:
    return " ".join(line.strip() for line in str(error).splitlines() if line.strip())


def _unknown_option(error: MissingConfigException, config_dir: Path) -> str:
    wanted = error.missing_cfg_file or ""
    group, _, option = wanted.partition("/")
    if option and (config_dir / group).is_dir():
        options = options_of(config_dir / group)
    else:
        group, _, option = wanted.rpartition("/")
        options = sorted(error.options or [])
    if not group:
        return f"{option}: no such configuration: choose one of {', '.join(options)}"
    return f"{group}={option}: no such option: choose one of {', '.join(options)}"


def options_of(folder: Path) -> list[str]:
    """The options of a group of the configuration, those of its subgroups as subgroup/option."""
    found = (file.relative_to(folder).with_suffix("") for file in folder.rglob("*.yaml"))
    return sorted(path.as_posix() for path in found if "common" not in path.parts)


def _unknown_setting(key: str, given: Sequence[str], config_dir: Path, compose: Compose) -> str:
    parent, _, leaf = key.rpartition(".")
    node = OmegaConf.select(_defaults(given, config_dir, compose), parent) if parent else None
    if not parent:
        node = _defaults(given, config_dir, compose)
    names = sorted(map(str, node)) if isinstance(node, DictConfig) else []
    if not parent:
        names = sorted({*names, *_groups(config_dir)})
    prefix = f"{parent}." if parent else ""
    near = difflib.get_close_matches(leaf, names, n=2, cutoff=0.6)
    if near:
        mend = f"did you mean {' or '.join(prefix + name for name in near)}?"
    elif names:
        mend = f"choose one of {', '.join(names)}"
    else:
        mend = f"there is no {parent!r} with settings"
    return f"{key}: no such setting: {mend}"


def _groups(config_dir: Path) -> list[str]:
    return [entry.name for entry in config_dir.iterdir() if entry.is_dir()]


def _defaults(given: Sequence[str], config_dir: Path, compose: Compose) -> DictConfig:
    """The configuration with the options chosen in ``given``, but with no value changed."""
    chosen = []
    for text in given:
        key = text.lstrip("+~").split("=")[0]
        if "=" in text and (config_dir / key).is_dir():
            chosen.append(text.split(",")[0])  # of a sweep the first
    try:
        return compose(chosen)
    except HydraException:
        return compose([])


def _bad_instance(error: InstantiationException) -> str | None:
    """Constructors refuse values with ValueError; anything else is a defect."""
    cause = error.__cause__
    where = re.search(r"full_key: (\S+)", str(error))
    if isinstance(cause, ValueError) or "unexpected keyword argument" in str(cause):
        return f"{where[1] if where else 'configuration'}: {_join(cause or error)}"
    return None


def check_settings(
    config: DictConfig, overrides: list[str], config_dir: Path, compose: Compose
) -> None:
    """Refuse values of the wrong kind, such as text for a number.

    Raises ``InputError``.
    """
    defaults = None
    for override in OverridesParser.create().parse_overrides(overrides):
        key = override.key_or_group
        if (config_dir / key).is_dir() or override.is_add() or override.is_delete():
            continue
        defaults = defaults or _defaults(overrides, config_dir, compose)
        _check_kind(key, _select(defaults, key), _select(config, key))
    _check_image_size(config)


def _select(config: DictConfig, key: str) -> Any:
    try:
        return OmegaConf.select(config, key)
    except OmegaConfBaseException:
        return None


def _check_kind(key: str, expected: Any, found: Any) -> None:
    if expected is None or found is None or found == "auto" or key in _ANY_KIND:
        return
    number = (int, float)
    kinds = (
        (bool, bool, "true or false"),
        (number, number, f"a number such as {expected}"),
        (ListConfig, ListConfig, f"a list such as {expected}"),
        (DictConfig, DictConfig, f"settings such as {key}.{_first(expected)}=..."),
    )
    for expected_kind, kind, meaning in kinds:
        if isinstance(expected, expected_kind):
            if not isinstance(found, kind) or (kind is number and isinstance(found, bool)):
                raise InputError(f"{key}={found}: must be {meaning}")
            return


def _first(node: Any) -> str:
    return str(next(iter(node), "key")) if isinstance(node, DictConfig) else ""


def _check_image_size(config: DictConfig) -> None:
    size = _select(config, "image_size")
    if size is None:
        return
    if len(size) != 2 or not all(isinstance(n, int) and n > 0 for n in size):
        raise InputError(f"image_size={list(size)}: must be [height, width] in pixels")
    queries = _select(config, "model.detector.selection.num_queries")
    strides = _select(config, "strides")
    if queries is None or strides is None:
        return
    tokens = sum(-(-size[0] // stride) * -(-size[1] // stride) for stride in strides)
    if tokens < queries:
        raise InputError(
            f"image_size={list(size)}: gives {tokens} tokens, fewer than the {queries} queries: "
            "use a larger image or lower model.detector.selection.num_queries"
        )
