"""Reading checkpoints safely, and starting one stage from another."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from occdetr.errors import InputError
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.instantiate import build_allowed, check_plain, refuse_larger
from occdetr.training.renames import migrate

KEY = "occdetr"  # where a checkpoint keeps its stage and the version that wrote it
HYPER_PARAMETERS = "hyper_parameters"  # where Lightning keeps the configuration
MODEL_PREFIX = "model."


@dataclass
class Checkpoint:
    """A training checkpoint: the configuration of its run, its stage, the model's weights.

    ``config`` is in today's form, whatever the version that wrote it (``renames.migrate``).
    """

    path: Path
    config: dict[str, Any]
    stage: str
    version: str
    model_state: dict[str, Tensor]
    allow: tuple[str, ...] = ()


def read_checkpoint(path: str | Path, allow: Sequence[str] = ()) -> Checkpoint:
    """Load with ``weights_only=True``: a checkpoint cannot run code.

    ``allow``: modules besides this package's whose classes its configuration may name.

    Raises ``InputError`` when the file is missing, broken or not one of this package's.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"checkpoint={path}: no such file; give a last.ckpt of a run in outputs/")
    try:
        refuse_compressed(path)
        raw = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(
            f"checkpoint={path}: not a readable checkpoint ({type(error).__name__}); "
            "it may be cut short: train again or give another file"
        ) from error
    try:
        about, state = raw[KEY], raw["state_dict"]
        # before Lightning kept it, the configuration was beside the stage
        config = about.get("config") or raw[HYPER_PARAMETERS]
        stage, version = str(about["stage"]), str(about["version"])
        state = {
            name.removeprefix(MODEL_PREFIX): value
            for name, value in state.items()
            if name.startswith(MODEL_PREFIX) and isinstance(value, Tensor)
        }
    except (AttributeError, KeyError, TypeError, IndexError):
        raise InputError(
            f"checkpoint={path}: was not written by occdetr.train; give one that was"
        ) from None
    try:
        check_plain(config)
        migrated = migrate(config)
    except InputError as error:
        raise InputError(f"checkpoint={path}: {error}") from None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"checkpoint={path}: its configuration cannot be read") from error
    return Checkpoint(path, migrated, stage, version, state, tuple(allow))


def refuse_compressed(path: Path) -> None:
    """``torch.save`` does not compress; a small file could fill the memory else.

    Raises ``ValueError``.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as file:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in file.infolist()):
                raise ValueError("compressed")


def restore_model(path: str | Path, allow: Sequence[str] = ()) -> tuple[OccupancyDETR, Checkpoint]:
    """The trained network of a checkpoint, in evaluation mode on the CPU, and the checkpoint.

    Raises ``InputError`` like ``read_checkpoint``, when the configuration names a class that is
    not this package's, and when the weights do not fit.
    """
    checkpoint = read_checkpoint(path, allow)
    return rebuild_model(checkpoint).eval(), checkpoint


def rebuild_model(checkpoint: Checkpoint) -> OccupancyDETR:
    """The network of a checkpoint with its weights. Raises as ``restore_model``."""
    node = _without_pretrained(section(checkpoint, "model"))
    backbone = node.get("backbone") or {}
    node = {**node, "backbone": {**backbone, "weights": None}}
    try:
        if not checkpoint.allow:
            refuse_larger(node, sum(value.numel() for value in checkpoint.model_state.values()))
        model = build_allowed(node, checkpoint.allow)
    except InputError as error:
        raise InputError(f"checkpoint={checkpoint.path}: {error}") from error
    load_exactly(model, checkpoint)
    return model


def _without_pretrained(node: Any) -> Any:
    """A model's node without files of weights: they are in the checkpoint."""
    if isinstance(node, dict):
        plain = {key: _without_pretrained(value) for key, value in node.items()}
        return {**plain, "weights": None} if isinstance(plain.get("weights"), str) else plain
    return [_without_pretrained(value) for value in node] if isinstance(node, list) else node


def section(checkpoint: Checkpoint, name: str) -> dict[str, Any]:
    """A node of a checkpoint's configuration. Raises ``InputError`` if there is none."""
    node = checkpoint.config.get(name)
    if not isinstance(node, dict):
        raise InputError(
            f"checkpoint={checkpoint.path}: its configuration has no {name!r}; give another file"
        )
    return node


def load_model_state(model: nn.Module, state: dict[str, Tensor]) -> list[str]:
    """Load every weight that fits; return the names of the model's weights that are not in it.

    A full training takes a pretraining's weights like this: what pretraining does not have keeps
    its initial values.
    """
    own = model.state_dict()
    fitting = {n: v for n, v in state.items() if n in own and own[n].shape == v.shape}
    model.load_state_dict(fitting, strict=False)
    return [name for name in own if name not in fitting]


def load_exactly(model: nn.Module, checkpoint: Checkpoint) -> None:
    """Load a model's own checkpoint. Raises InputError when a weight is missing or does not fit."""
    missing = load_model_state(model, checkpoint.model_state)
    if missing:
        raise InputError(
            f"checkpoint={checkpoint.path}: does not fit the model ({len(missing)} weights, first "
            f"{missing[0]}); evaluate it with the model it was trained with"
        )
