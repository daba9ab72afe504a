"""Errors of the user, in settings or files, as one line each."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    ConfigTypeError,
    InterpolationKeyError,
    MissingMandatoryValue,
    OmegaConfBaseException,
    ReadonlyConfigError,
)
from yaml import YAMLError

from occdetr.cli.plugins import explain_plugin
from occdetr.cli.system_errors import explain_system
from occdetr.errors import InputError

#: Composes the entry point's configuration from overrides.
Compose = Callable[[list[str]], DictConfig]


def explain(
    error: BaseException, overrides: Sequence[str], config_dir: Path, compose: Compose
) -> str | None:
    """One line for an error that the user can fix; None for a defect of the program."""
    for cause in _causes(error):
        if isinstance(cause, InputError):
            return _without_worker(str(cause))
    if removed := _removed_setting(error, overrides):
        return f"{removed}: this command needs that setting: leave {removed} out"
    if isinstance(error, MissingConfigException):
        return _unknown_option(error, config_dir)
    if isinstance(error, OverrideParseException):
        reason = str(error).splitlines()[0]
        remedy = (
            "quote each setting, as in \"overrides=['model=small','trainer=gpu']\""
            if str(error.override).startswith("overrides=")
            else "write settings as key=value"
        )
        return f"{error.override!r} cannot be read ({reason}): {remedy}"
    if isinstance(error, ConfigCompositionException):
        if isinstance(error.__cause__, ConfigTypeError):
            return _another_kind(error, error.__cause__)
        unknown = re.search(r"Could not override '([^']*)'", str(error))
        return (
            _unknown_setting(unknown[1], overrides, config_dir, compose)
            if unknown
            else _join(error)
        )
    if isinstance(error, InstantiationException):
        return _bad_instance(error)
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} is not set: give it, as in {error.full_key}=<value>"
    if isinstance(error, (ReadonlyConfigError, ConfigAttributeError, ConfigKeyError)):
        return None  # our own code asked for what is not there
    if isinstance(error, InterpolationKeyError):
        return _missing_reference(error, overrides, config_dir)
    if isinstance(error, (OmegaConfBaseException, HydraException, YAMLError)):
        return _join(error)
    if isinstance(error, ValueError) and str(error).startswith("Config group override"):
        return f"{' '.join(overrides)}: a group takes the name of an option, as in model=tiny"
    return explain_plugin(error) or explain_system(error)


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


def _removed_setting(error: BaseException, overrides: Sequence[str]) -> str | None:
    """The override, as in ``~seed``, that has removed what an error of the configuration lacks."""
    removed = [text for text in overrides if text.startswith("~")]
    if isinstance(error, InterpolationKeyError):  # names what a removed group had
        return next(iter(removed), None)
    if not isinstance(error, (ConfigAttributeError, ConfigKeyError, InstantiationException)):
        return None
    for text in removed:
        last = re.split(r"[./]", text[1:].partition("=")[0])[-1]
        if re.search(rf"\b{re.escape(last)}\b", str(error)):
            return text
    return None


def _missing_reference(
    error: InterpolationKeyError, overrides: Sequence[str], config_dir: Path
) -> str:
    """Names the group whose option lacks what another setting refers to."""
    found = re.search(r"Interpolation key '([^']*)'", str(error))
    key = found[1] if found else ""
    group = key.partition(".")[0]
    if not (group and (config_dir / group).is_dir()):
        return _join(error)
    chosen = next((text for text in overrides if text.startswith(f"{group}=")), group)
    others = ", ".join(options_of(config_dir / group))
    return f"{chosen}: has no {key}, which {error.full_key} needs: choose another of {others}"


def _another_kind(error: BaseException, cause: ConfigTypeError) -> str:
    """A list was given for named settings, or the other way round."""
    given = str(error).removeprefix("Error merging override ")
    wanted = "a list, as in [a,b]" if cause.object_type is list else "settings, as in {a: 1}"
    return f"{given}: give {wanted}"


def _unknown_option(error: MissingConfigException, config_dir: Path) -> str:
    """Hydra's own words list neither options of subgroups nor, for a list of options, any."""
    wanted = error.missing_cfg_file or ""
    group, _, option = wanted.partition("/")
    if option and group != "hydra" and (config_dir / group).is_dir():
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
    """Names the settings beside it that are spelt alike."""
    parent, _, leaf = key.rpartition(".")
    if parent.split(".")[0] == "hydra":
        return f"{key}: no such setting: --cfg hydra shows them; or add it with +{key}=<value>"
    groups = [entry.name for entry in config_dir.iterdir() if entry.is_dir()]
    groups.remove("hydra")
    if key in groups:
        return f"{key}: this command has no such group: leave it out"
    chosen = [text for text in given if text.lstrip("+~").split("=")[0] in groups]
    try:
        config = compose([text.split(",")[0] if "[" not in text else text for text in chosen])
    except HydraException:
        config = compose([])
    node = OmegaConf.select(config, parent) if parent else config
    names = sorted(map(str, node)) if isinstance(node, DictConfig) else []
    names += [] if parent else groups
    near = difflib.get_close_matches(leaf, names, n=2, cutoff=0.6)
    prefix = f"{parent}." if parent else ""
    if near:
        advice = f"did you mean {' or '.join(prefix + name for name in near)}?"
    elif names:
        advice = f"choose one of {', '.join(dict.fromkeys(names))}, or add it with +{key}=<value>"
    else:
        advice = f"there is no {parent!r} with settings"
    return f"{key}: no such setting: {advice}"


def _bad_instance(error: InstantiationException) -> str | None:
    """Constructors refuse values with ValueError; most other errors in them are defects."""
    cause = error.__cause__
    key = re.search(r"full_key: (\S+)", str(error))
    where = key[1] if key else "configuration"
    if isinstance(cause, ModuleNotFoundError):
        return (
            f"{where}: {_join(cause)}: a package is not installed: "
            f"pip install 'occdetr[{where.rpartition('.')[2]}]'"
        )
    if isinstance(cause, ValueError) or "unexpected keyword argument" in str(cause):
        return f"{where}: {_join(cause or error)}"
    if cause is None or isinstance(cause, (ImportError, AttributeError)):
        return f"{where}: {_join(cause or error)}" if "locating target" in str(error) else None
    line = explain_system(error)
    return f"{where}: {line}" if line else None
