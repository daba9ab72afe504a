"""Whether a value of a setting has the type of an annotation, and that type in words."""

from __future__ import annotations

import inspect
import math
import os
import types
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin

_LISTS = (list, tuple, Sequence, Iterable)
_TEXTS: Any = (str, os.PathLike)


def accepts(hint: Any, value: Any) -> bool:
    """Whether a plain value (as in YAML) fits an annotation.

    Nothing is converted: text is no number, and true is none. A number is also text, such as a
    folder named 2024. NaN fits nothing. A class of this package takes a node; an annotation that
    says nothing about plain values takes any.
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(accepts(each, value) for each in arguments)
    if hint in (None, type(None)) or value is None:
        return value is None and hint in (None, type(None), Any, inspect.Parameter.empty)
    if origin is Literal:
        return any(value == each and type(value) is type(each) for each in arguments)
    if hint in (int, bool):
        return type(value) is hint
    if hint is float:
        return type(value) in (int, float) and not math.isnan(value)
    if _is_text(hint):
        return isinstance(value, (str, int, float))
    if origin in _LISTS:
        return isinstance(value, list) and _accepts_items(arguments, value)
    if origin in (dict, Mapping):
        return isinstance(value, dict) and all(accepts(arguments[1], v) for v in value.values())
    return not _is_part(hint) or isinstance(value, dict)


def _accepts_items(hints: Sequence[Any], values: list[Any]) -> bool:
    """A list of any length, or, as in ``tuple[int, int]``, of one item for each hint."""
    if len(hints) > 1 and hints[-1] is not Ellipsis:
        return len(hints) == len(values) and all(map(accepts, hints, values))
    return all(accepts(hints[0], value) for value in values)


def advice(hint: Any) -> str:
    """What to do for an annotation, as in "give a list of whole numbers, or null"."""
    text = _words(hint)
    return f"choose {text}" if text.startswith("one of ") else f"give {text}"


def _words(hint: Any) -> str:
    origin: Any = get_origin(hint)
    arguments: tuple[Any, ...] = get_args(hint)
    if origin in (Union, types.UnionType):
        named = [each for a in arguments if get_origin(a) is Literal for each in get_args(a)]
        kinds = [f"one of {', '.join(dict.fromkeys(map(str, named)))}"] if named else []
        kinds += [_words(a) for a in arguments if get_origin(a) is not Literal]
        whole = {"a whole number"} if "a number" in kinds else set()
        return ", or ".join(kind for kind in dict.fromkeys(kinds) if kind not in whole)
    if origin is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin in _LISTS:
        item, *more = arguments
        some = f"{len(arguments)} " if more and more[-1] is not ... else ""
        return f"a list of {some}{_plural(item)}"
    if origin in (dict, Mapping):
        return f"names, each with {_words(arguments[1])}"
    if _is_text(hint):
        return "text"
    named = {int: "a whole number", float: "a number", bool: "true or false", type(None): "null"}
    return named.get(hint, "a node with _target_")


def _plural(hint: Any) -> str:
    kinds = {int: "whole numbers", float: "numbers", str: "names"}
    return kinds.get(hint) or f"values, each {_words(hint)}"


def _is_text(hint: Any) -> bool:
    return inspect.isclass(hint) and issubclass(hint, _TEXTS)


def _is_part(hint: Any) -> bool:
    return inspect.isclass(hint) and hint.__module__.startswith("occdetr.")
