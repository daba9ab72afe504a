"""Reading checkpoints safely, and starting one stage from another."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from occdetr.errors import InputError
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.instantiate import build_allowed
from occdetr.training.renames import migrate

KEY = "occdetr"  # where a checkpoint keeps its stage and the version that wrote it
HYPER_PARAMETERS = "hyper_parameters"  # where Lightning keeps the configuration
MODEL_PREFIX = "model."


@dataclass
class Checkpoint:
    """A training checkpoint: the configuration of its run, its stage, the model's weights.

    ``config`` is in today's form, whatever the version that wrote it (``renames.migrate``).
    ``epochs`` and ``steps`` are how far its run was: whole epochs, and optimizer steps.
    """

    path: Path
    config: dict[str, Any]
    stage: str
    version: str
    model_state: dict[str, Tensor]
    epochs: int = 0
    steps: int = 0


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Load with ``weights_only=True``: a checkpoint cannot run code.

    Raises ``InputError`` when the file is missing, broken or not one of this package's.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"checkpoint={path}: no such file; give a last.ckpt of a run in outputs/")
    try:
        raw = torch.load(path, map_location="cpu", weights_only=True)
        check_sums(path)
    except Exception as error:
        raise InputError(
            f"checkpoint={path}: not a readable checkpoint ({type(error).__name__}); "
            "it may be cut short or damaged: train again or give another file"
        ) from error
    about = raw.get(KEY) if isinstance(raw, dict) else None
    # before Lightning kept it, the configuration was beside the stage
    config = (about.get("config") or raw.get(HYPER_PARAMETERS)) if about else None
    if about is None or config is None or "state_dict" not in raw:
        raise InputError(f"checkpoint={path}: was not written by occdetr.train; give one that was")
    state = {
        name.removeprefix(MODEL_PREFIX): value
        for name, value in raw["state_dict"].items()
        if name.startswith(MODEL_PREFIX)
    }
    done = Checkpoint(path, migrate(config), about["stage"], about["version"], state)
    if "loops" in raw:  # of older files some have none
        done.epochs = raw["loops"]["fit_loop"]["epoch_progress"]["current"]["processed"]
        done.steps = raw["global_step"]
    return done


def check_sums(path: Path) -> None:
    """Raises ``ValueError`` if a file in the archive is damaged, which torch does not look for."""
    with zipfile.ZipFile(path) as archive:
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"{damaged} is damaged")


def restore_model(path: str | Path) -> tuple[OccupancyDETR, Checkpoint]:
    """The trained network of a checkpoint, in evaluation mode on the CPU, and the checkpoint.

    Raises ``InputError`` like ``read_checkpoint``, when the configuration names a class that is
    not this package's, and when the weights do not fit.
    """
    checkpoint = read_checkpoint(path)
    return rebuild_model(checkpoint).eval(), checkpoint


def rebuild_model(checkpoint: Checkpoint) -> OccupancyDETR:
    """The network of a checkpoint with its weights. Raises as ``restore_model``."""
    node = section(checkpoint, "model")
    backbone = node.get("backbone") or {}
    node = {**node, "backbone": {**backbone, "weights": None}}  # they are in the checkpoint
    try:
        model = build_allowed(node)
    except InputError as error:
        raise InputError(f"checkpoint={checkpoint.path}: {error}") from error
    load_exactly(model, checkpoint)
    return model


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
