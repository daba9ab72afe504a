"""Settings on the command line whose values are paths: they arrive as they were typed.

Hydra's grammar reads ``images=2024`` as a number, ``outputs=2024_05_01`` as 20240501, and refuses
spaces at the ends, parentheses, commas, ``=``, ``~``, ``#``, umlauts and other letters. Values of
the settings below are therefore quoted before Hydra reads them.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException

from occdetr.errors import InputError

#: Settings that are paths, of all entry points.
PATHS = frozenset(
    (
        *("outputs", "output", "folder", "results", "page", "images", "calib"),
        *("checkpoint", "released", "start", "init_from", "resume", "data.root", "data.cache_dir"),
        *("model.backbone.weights", "trainer.default_root_dir"),
        *("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir"),
    )
)
#: Last names of settings that are paths wherever they are.
_PATH_NAMES = ("save_dir", "dirpath")
_SETTING = re.compile(r"(\+{0,2})([\w.]+)=(.*)", re.DOTALL)
#: ``${`` that begins no interpolation.
_LONE_BRACE = re.compile(r"(?<!\\)\$\{(?![^}]*\})")


def literal_paths(arguments: Sequence[str]) -> list[str]:
    """The command line with its paths in quotes where Hydra would read something else.

    ``~`` is expanded; ``null`` and interpolations (``${...}``) keep their meaning, as do the
    commas of a sweep (``-m``). Values in Hydra's own quotes stay.

    Raises ``InputError`` for an empty path and for one that is not Unicode.
    """
    sweeps = bool({"-m", "--multirun", "hydra.mode=MULTIRUN"} & set(arguments))
    return [literal_path(argument, sweeps) for argument in arguments]


def literal_path(argument: str, sweeps: bool = False) -> str:
    """One word of ``literal_paths``."""
    try:
        argument.encode()
    except UnicodeEncodeError:
        raise InputError(f"{argument!r}: is not Unicode (UTF-8): rename that file") from None
    plus, key, value = _split(argument)
    if key is None or value == "null":
        return argument
    if not value.strip():
        raise InputError(f"{key}= is empty: give a path, or leave {key} out")
    if sweeps and "," in value and not re.search(r"[\"'(\[{]", value):
        return f"{plus}{key}={','.join(map(literal, value.split(',')))}"
    if sweeps and (read := _read(value)) is not None and read.is_sweep_override():
        return argument
    return f"{plus}{key}={literal(value)}"


def as_typed(argument: str) -> str:
    """The inverse of ``literal_path``: without Hydra's quotes around a path."""
    plus, key, value = _split(argument)
    text = None if key is None else _quoted_text(value)
    return argument if text is None else f"{plus}{key}={text}"


def command_line(module: str, overrides: Iterable[str]) -> str:
    """``python -m <module> <overrides>``, to be copied into a shell."""
    return shlex.join(["python", "-m", module, *map(as_typed, overrides)])


def changed_settings(override: str) -> list[str]:
    """The groups and settings that an override changes, as in ``data.root``.

    Of named settings (``data={root: a}``) each one; none of an override that Hydra cannot read.
    Raises ``InputError`` as ``literal_path`` does.
    """
    try:
        read = OverridesParser.create().parse_override(literal_path(override))
    except HydraException:
        return []
    return list(_leaves(read.key_or_group, read.value()))


def overrides_of(group: str, overrides: Iterable[str]) -> list[str]:
    """Those of ``overrides`` that change a setting of a group, such as ``data``."""
    return [
        text
        for text in overrides
        if any(setting.startswith(f"{group}.") for setting in changed_settings(text))
    ]


def refuse_overrides(overrides: Iterable[str], decided: Mapping[str, str]) -> None:
    """Raises ``InputError`` for an override of what a program decides itself for others that it
    runs. ``decided``: patterns of groups and settings, and what the user is to do instead."""
    for text in overrides:
        for setting in changed_settings(text):
            for pattern, remedy in decided.items():
                if fnmatchcase(setting, pattern):
                    raise InputError(f"overrides: {text}: {remedy}")


def _leaves(key: str, value: Any) -> Iterator[str]:
    if not isinstance(value, dict):
        yield key
        return
    for name, inner in value.items():
        yield from _leaves(f"{key}.{name}", inner)


def _split(argument: str) -> tuple[str, str | None, str]:
    """Plus signs, key and value of a setting that is a path; None as the key of another word."""
    match = _SETTING.fullmatch(argument)
    if match is None or not (match[2] in PATHS or match[2].rpartition(".")[2] in _PATH_NAMES):
        return "", None, ""
    return match[1], match[2], match[3]


def literal(value: str) -> str:
    """A path as the value of a setting, quoted where Hydra would read something else."""
    quoted = _quoted_text(value)
    path = os.path.expanduser(value if quoted is None else quoted)
    path = _LONE_BRACE.sub(r"\\${", path)
    read = _read(path)
    if quoted is None and read is not None and not read.is_sweep_override():
        same = read.value() == path and isinstance(read.value(), str)
        if same and not isinstance(_raw(read), QuotedString):
            return path
    return QuotedString(path, Quote.single).with_quotes()


def _quoted_text(value: str) -> str | None:
    """The text between Hydra's quotes; None if there are none."""
    raw = _raw(_read(value)) if value[:1] in ("'", '"') else None
    return raw.text if isinstance(raw, QuotedString) else None


def _read(value: str) -> Override | None:
    """``value`` as Hydra reads it; None if it does not."""
    try:
        return OverridesParser.create().parse_override(f"key={value}")
    except HydraException:
        return None


def _raw(read: Override | None) -> Any:
    return None if read is None else read._value
