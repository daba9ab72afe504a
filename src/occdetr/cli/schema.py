"""Types of the settings, as structured configurations.

The settings of the entry points are fields of ``Settings``. A node with a ``_target_`` takes its
types from the constructor's annotations, so that no type is written down twice. Neither is in the
defaults lists of ``conf``, because a structured node is closed: a keyword of the Trainer, or of
another class by ``_target_``, could not be added with ``+``.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, ValidationError

from occdetr.errors import InputError

Number = float | None
Whole = int | None
Text = str | None
Flag = bool | None


@dataclass
class Settings:
    """The settings of all entry points outside of nodes with a ``_target_``."""

    seed: Whole = None
    outputs: Text = None
    init_from: Text = None
    resume: Text = None
    checkpoint: Text = None
    start: Text = None
    epochs: dict[str, int] = field(default_factory=dict)
    batch: dict[str, int] = field(default_factory=dict)
    check_every: dict[str, int] = field(default_factory=dict)
    strides: list[int] | None = None
    foreground_classes: list[int] | None = None
    mask_classes: list[int] | None = None
    roi_scale: Number = None
    early_matching_share: Number = None
    upper_bound: Flag = None
    diagnose: Flag = None
    save_predictions: Flag = None
    exchange_images: Flag = None
    rebuild: Flag = None
    backward: Flag = None
    photograph: Flag = None
    split: Text = None
    device: Text = None
    batch_size: Whole = None
    threads: Whole = None
    workers: Whole = None
    worlds: Whole = None
    width: Whole = None
    sheet: Whole = None
    sheet_width: Whole = None
    repeats: Whole = None
    warmup: Whole = None
    samples: Whole = None
    score_threshold: Number = None


def check_types(config: DictConfig) -> None:
    """Raises ``InputError`` for a setting of another type than ``Settings`` or the constructor of
    its node has, and for an ``image_size`` that is not a size. Other settings may be anything."""
    _check(OmegaConf.structured(Settings()), config, "")
    for path, node in _targets(config, ""):
        _check(OmegaConf.structured(_types(node["_target_"])), node, f"{path}.")
        _check_words(_hints(node["_target_"]), node, f"{path}.")
    size = OmegaConf.select(config, "image_size")
    if size is not None and not _is_size(size):
        raise InputError(f"image_size={size}: must be [height, width] in pixels")


def _check(schema: Any, node: DictConfig, prefix: str) -> None:
    """Convert those settings of a node that the schema has a type for.

    An interpolation is checked at the place that it refers to.
    """
    for key in schema:
        if key not in node or OmegaConf.is_missing(node, key):
            continue
        if OmegaConf.is_interpolation(node, key) or node[key] is None:
            continue
        value = node[key]
        try:
            schema[key] = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
        except ValidationError as error:
            raise InputError(f"{prefix}{key}: {str(error).splitlines()[0]}") from error


def _targets(node: DictConfig, path: str) -> Iterator[tuple[str, DictConfig]]:
    """All nodes that describe an object, where they stand first, and their paths."""
    if path and isinstance(node.get("_target_"), str):
        yield path, node
    for key in map(str, node):
        if OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key):
            continue
        if isinstance(node[key], DictConfig):
            yield from _targets(node[key], f"{path}.{key}" if path else key)


def _check_words(hints: Mapping[str, Any], node: DictConfig, prefix: str) -> None:
    """Refuse words that a ``Literal`` annotation does not list.

    An interpolation that refers to nothing, as in ``evaluate``, is left to the command.
    """
    for key, hint in hints.items():
        if get_origin(hint) is not Literal or key not in node or OmegaConf.is_missing(node, key):
            continue
        with contextlib.suppress(InterpolationKeyError):
            if node[key] not in get_args(hint):
                words = ", ".join(map(str, get_args(hint)))
                raise InputError(f"{prefix}{key}={node[key]}: choose one of {words}")


@functools.cache
def _types(target: str) -> type:
    """A dataclass of those keywords of a constructor whose types OmegaConf can check."""
    kinds = {name: _simple(hint) for name, hint in _hints(target).items()}
    fields: list[Any] = [(name, kind | None, None) for name, kind in kinds.items() if kind]
    return make_dataclass("Keywords", fields)


@functools.cache
def _hints(target: str) -> dict[str, Any]:
    """The annotations of a constructor's keywords; a data module declares some in ``parts``.

    What cannot be imported has none: instantiating it reports that.
    """
    found: dict[str, Any] = {}
    try:
        constructor = get_object(target)
        for part in (constructor, *getattr(constructor, "parts", ())):
            plain = inspect.isclass(part) and "__dataclass_fields__" not in vars(part)
            hints = get_type_hints(part.__init__ if plain else part)
            found |= {name: hints.get(name) for name in inspect.signature(part).parameters}
    except Exception:
        return {}
    return found


def _simple(hint: Any) -> Any:
    """The type that OmegaConf checks for an annotation; None if it cannot."""
    origin, arguments = get_origin(hint), [a for a in get_args(hint) if a is not type(None)]
    if hint in (int, float, bool, str):
        return hint
    if origin in (Union, types.UnionType):
        return float if {*arguments} == {int, float} else _only({_simple(a) for a in arguments})
    if origin is Literal and all(isinstance(each, str) for each in arguments):
        return str
    if origin in (list, tuple, Sequence):
        kind = _only({_simple(a) for a in arguments if a is not Ellipsis})
        return None if kind is None else list[kind]
    if origin in (dict, Mapping) and arguments[0] is str:
        kind = _simple(arguments[1])
        return None if kind is None else dict[str, kind]
    return None


def _only(kinds: set[Any]) -> Any:
    return kinds.pop() if len(kinds) == 1 else None


def _is_size(size: Any) -> bool:
    whole = OmegaConf.is_list(size) and all(type(n) is int and n > 0 for n in size)
    return whole and len(size) == 2
