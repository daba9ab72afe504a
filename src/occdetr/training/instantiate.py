"""Objects from the configuration inside a checkpoint, which may come from anywhere.

Hydra's ``instantiate`` calls whatever ``_target_`` names. Here only classes of this package's
network, losses, stages and data modules are constructed.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from occdetr.errors import InputError

TARGET = "_target_"

#: Modules, and packages (with a dot at the end), whose classes a checkpoint may name.
ALLOWED = (
    *("occdetr.models.", "occdetr.losses.", "occdetr.geometry.rois"),
    *("occdetr.training.optimizer", "occdetr.training.scheduler"),
    *("occdetr.training.pretrain", "occdetr.training.full"),
    *("occdetr.data.datamodule", "occdetr.data.objects", "occdetr.streets.datamodule"),
)


def build_allowed(node: Any, **parts: Any) -> Any:
    """Construct what a node describes: dictionaries with ``_target_``, also inside others.

    ``parts`` are further keywords of the outermost constructor, and take precedence.

    Raises ``InputError`` for a ``_target_`` outside ``ALLOWED`` and for keywords that its
    constructor refuses.
    """
    if isinstance(node, Mapping) and TARGET in node:
        return _construct(node, parts)
    if isinstance(node, Mapping):
        return {key: build_allowed(value) for key, value in node.items()}
    return [build_allowed(value) for value in node] if isinstance(node, (list, tuple)) else node


def targets_of(node: Any) -> set[str]:
    """Every ``_target_`` in a node, at any depth."""
    if isinstance(node, Mapping):
        own = {str(node[TARGET])} if TARGET in node else set()
        return own.union(*map(targets_of, node.values()))
    return set().union(*map(targets_of, node)) if isinstance(node, (list, tuple)) else set()


def _construct(node: Mapping[str, Any], parts: Mapping[str, Any]) -> Any:
    target = allowed_class(node[TARGET])
    settings = {key: value for key, value in node.items() if key != TARGET and key not in parts}
    special = [key for key in settings if str(key).startswith("_")]
    if special:
        raise InputError(f"{node[TARGET]}: {special[0]} is not supported in a checkpoint")
    keywords = {key: build_allowed(value) for key, value in settings.items()}
    try:
        return target(**keywords, **parts)
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(f"{node[TARGET]}: {error}") from error


def allowed_class(path: Any) -> type:
    """The class that ``path`` names, if it is one of ``ALLOWED`` modules and defined there.

    Raises ``InputError`` otherwise, before anything is imported from elsewhere.
    """
    module_name, _, name = str(path).rpartition(".")
    allowed = any(
        module_name.startswith(entry) if entry.endswith(".") else module_name == entry
        for entry in ALLOWED
    )
    if not allowed:
        raise InputError(
            f"{TARGET}={path}: a checkpoint may only name this package's own classes; "
            "do not use this checkpoint unless you trust its author"
        )
    try:
        found = getattr(importlib.import_module(module_name), name, None)
    except ModuleNotFoundError:
        found = None
    # an allowed module has names of other modules too, such as torch
    if not isinstance(found, type) or found.__module__ != module_name:
        raise InputError(
            f"{TARGET}={path}: there is no such class in this version of occdetr; "
            "use the version that wrote the checkpoint"
        )
    return found
