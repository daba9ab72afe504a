"""Objects from the configuration inside a checkpoint, which may come from anywhere.

Hydra's ``instantiate`` calls whatever ``_target_`` names. Here only classes of this package's
network, losses, stages and data modules are constructed, and those of modules that the user allows
by an explicit setting (``allow=[mypackage.models]``).
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch.nn.modules.module import register_module_parameter_registration_hook

from occdetr.errors import InputError

TARGET = "_target_"

#: Modules, and packages (with a dot at the end), whose classes a checkpoint may name.
ALLOWED = (
    *("occdetr.models.", "occdetr.losses.", "occdetr.geometry.rois"),
    *("occdetr.training.optimizer", "occdetr.training.scheduler"),
    *("occdetr.training.pretrain", "occdetr.training.full"),
    *("occdetr.data.datamodule", "occdetr.data.objects", "occdetr.streets.datamodule"),
)


#: Most levels and entries of a configuration; ours have 6 levels and some 300 entries.
MAX_DEPTH, MAX_ENTRIES = 50, 100_000


def check_plain(config: Any) -> None:
    """Raises ``InputError`` if a configuration has anything but named entries, lists and plain
    values, refers to something (``${oc.env:HOME}``), or is nested or long beyond all use."""
    level, count = [config], 0
    for _ in range(MAX_DEPTH):
        below: list[Any] = []
        for node in level:
            if isinstance(node, Mapping):
                below += [*node, *node.values()]
            elif isinstance(node, (list, tuple)):
                below += node
            elif isinstance(node, str) and "${" in node:
                raise InputError(f"its configuration refers to {node}: use another checkpoint")
            elif not isinstance(node, (str, int, float, type(None))):
                raise InputError(f"its configuration has a {type(node).__name__}: use another one")
            if (count := count + 1) > MAX_ENTRIES or len(below) > MAX_ENTRIES:
                break
        level = below
        if not level or count > MAX_ENTRIES:
            break
    if level:
        raise InputError("its configuration is nested too deeply or too long: use another one")


def build_allowed(node: Any, allow: Sequence[str] = (), **parts: Any) -> Any:
    """Construct what a node describes: dictionaries with ``_target_``, also inside others.

    ``allow``: further modules and packages whose classes may be named. ``parts`` are further
    keywords of the outermost constructor, and take precedence.

    Raises ``InputError`` for a ``_target_`` outside ``ALLOWED`` and ``allow``, and if its
    constructor fails.
    """
    if isinstance(node, Mapping) and TARGET in node:
        return _construct(node, allow, parts)
    if isinstance(node, Mapping):
        return {key: build_allowed(value, allow) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [build_allowed(value, allow) for value in node]
    return node


def refuse_larger(node: Any, number: int) -> None:
    """Raises ``InputError`` if a network has more than ``number`` weights, before it takes memory.

    It is constructed on torch's device "meta" for that, up to the weight that is too many.
    """
    message, count = "its configuration is of a larger network than its weights", 0
    if largest_number(node) > number:
        raise InputError(message)

    def add(_module: Any, _name: str, parameter: Any) -> None:
        nonlocal count
        count += 0 if parameter is None else parameter.numel()
        if count > number:
            raise InputError(message)

    handle = register_module_parameter_registration_hook(add)
    try:
        with torch.device("meta"):
            build_allowed(node)
    finally:
        handle.remove()


def largest_number(node: Any) -> float:
    """The largest number in a node, at any depth."""
    if isinstance(node, (Mapping, list, tuple)):
        values = node.values() if isinstance(node, Mapping) else node
        return max(map(largest_number, values), default=0)
    return node if isinstance(node, (int, float)) else 0


def targets_of(node: Any) -> set[str]:
    """Every ``_target_`` in a node, at any depth."""
    if isinstance(node, Mapping):
        own = {str(node[TARGET])} if TARGET in node else set()
        return own.union(*map(targets_of, node.values()))
    return set().union(*map(targets_of, node)) if isinstance(node, (list, tuple)) else set()


def _construct(node: Mapping[str, Any], allow: Sequence[str], parts: Mapping[str, Any]) -> Any:
    target = allowed_class(node[TARGET], allow)
    settings = {key: value for key, value in node.items() if key != TARGET and key not in parts}
    special = [key for key in settings if str(key).startswith("_")]
    if special:
        raise InputError(f"{node[TARGET]}: {special[0]} is not supported in a checkpoint")
    keywords = {key: build_allowed(value, allow) for key, value in settings.items()}
    try:
        return target(**keywords, **parts)
    except InputError:
        raise
    except Exception as error:  # whatever a constructor makes of wrong values
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{node[TARGET]}: {reason}") from error


def allowed_class(path: Any, allow: Sequence[str] = ()) -> type:
    """The class that ``path`` names, if it is of ``ALLOWED`` modules or those of ``allow``, and
    defined there.

    Raises ``InputError`` otherwise, before anything is imported from elsewhere.
    """
    module_name, _, name = str(path).rpartition(".")
    own = any(
        module_name.startswith(entry) if entry.endswith(".") else module_name == entry
        for entry in ALLOWED
    )
    given = any(module_name == entry or module_name.startswith(f"{entry}.") for entry in allow)
    if not (own or given):
        raise InputError(
            f"{TARGET}={path}: a checkpoint may only name this package's own classes; if you "
            f"trust its author, allow its module, as in allow=[{module_name or 'mypackage'}]"
        )
    try:
        found = getattr(importlib.import_module(module_name), name, None)
    except ModuleNotFoundError as error:
        if given:
            raise InputError(f"{TARGET}={path}: {error}: install it, or add its folder") from None
        found = None
    # an allowed module has names of other modules too, such as torch
    if not isinstance(found, type) or found.__module__ != module_name:
        raise InputError(
            f"{TARGET}={path}: there is no such class in this version of "
            f"{module_name.split('.')[0]}; use the version that wrote the checkpoint"
        )
    return found
