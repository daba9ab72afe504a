"""Reading checkpoints safely, and starting one stage from another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from occdetr.errors import InputError
from occdetr.training.renames import migrate

KEY = "occdetr"  # where a checkpoint keeps what rebuilds its model
MODEL_PREFIX = "model."


@dataclass
class Checkpoint:
    """A training checkpoint: the composed config of its run, its stage, the model's weights."""

    path: Path
    config: dict[str, Any]
    stage: str
    version: str
    model_state: dict[str, Tensor]


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Load with ``weights_only=True``: a checkpoint cannot run code.

    Raises InputError when the file is missing, broken or not one of this package's.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"checkpoint={path}: no such file; give a last.ckpt of a run in outputs/")
    try:
        raw = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(
            f"checkpoint={path}: not a readable checkpoint ({type(error).__name__}); "
            "it may be cut short: train again or give another file"
        ) from error
    if not isinstance(raw, dict) or KEY not in raw or "state_dict" not in raw:
        raise InputError(f"checkpoint={path}: was not written by occdetr.train; give one that was")
    state = {
        name.removeprefix(MODEL_PREFIX): value
        for name, value in raw["state_dict"].items()
        if name.startswith(MODEL_PREFIX)
    }
    return Checkpoint(
        path, migrate(raw[KEY]["config"]), raw[KEY]["stage"], raw[KEY]["version"], state
    )


def load_model_state(model: nn.Module, state: dict[str, Tensor]) -> list[str]:
    """Load every weight that fits; return the names of the model's that found none.

    A full training takes a pretraining's weights so: what pretraining has not is left as it was.
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
