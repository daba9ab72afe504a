"""Reading checkpoints safely, and starting one stage from another."""

from __future__ import annotations

import math
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from occdetr.errors import InputError
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.instantiate import (
    allowed_class,
    build_allowed,
    check_plain,
    refuse_larger,
    targets_of,
)
from occdetr.training.released import SUFFIX, find_released, read_released, released_names
from occdetr.training.renames import migrate

KEY = "occdetr"  # where a checkpoint keeps its stage and the version that wrote it
HYPER_PARAMETERS = "hyper_parameters"  # where Lightning keeps the configuration
MODEL_PREFIX = "model."
#: What is said of a pretraining that is evaluated or predicts.
UNTRAINED_GRIDS = "stage=pretrain trains the detector alone: the grids are of an untrained decoder"
#: What a run needs of a checkpoint to continue.
RESUME_KEYS = ("loops", "optimizer_states", "lr_schedulers", "callbacks")
#: Of a network's weights and counters.
PLAIN_TYPES = (
    *(torch.float64, torch.float32, torch.float16, torch.bfloat16),
    *(torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool),
)
#: Of a weight.
MOST_AXES, MOST_VALUES = 8, 2**40
PRETRAINED = ("backbone", "encoder", "detector")  # the parts of the network


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
    resumable: bool = False
    allow: tuple[str, ...] = ()


def read_checkpoint(path: str | Path, allow: Sequence[str] = ()) -> Checkpoint:
    """Load with ``weights_only=True``: a checkpoint cannot run code.

    ``allow``: modules besides this package's whose classes its configuration may name.

    Raises ``InputError`` when the file is missing, broken or not one of this package's, and when a
    weight is not finite.
    """
    path = Path(path)
    file = find_released(path)
    if not file.is_file():
        names = "".join(f", or {name}" for name in released_names())
        raise InputError(
            f"checkpoint={path}: no such file; give a last.ckpt of a run in outputs/{names}"
        )
    read = _read_released if file.suffix == SUFFIX else _read_run
    config, about = read(path, file)
    try:
        check_plain(config)
        migrated = migrate(config)
    except InputError as error:
        raise InputError(f"checkpoint={path}: {error}") from None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        reason = "its configuration cannot be read: give another file"
        raise InputError(f"checkpoint={path}: {reason}") from error
    check_weights(path, about["model_state"], file.stat().st_size)
    return Checkpoint(path, migrated, **about, allow=tuple(allow))


def _read_run(path: Path, file: Path) -> tuple[Any, dict[str, Any]]:
    """The configuration of a training's checkpoint as it is, and fields of ``Checkpoint``."""
    try:
        check_archive(file)
        raw = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(
            f"checkpoint={path}: not a readable checkpoint ({type(error).__name__}); "
            "it may be cut short or damaged: train again or give another file"
        ) from error
    try:
        about, state = raw[KEY], raw["state_dict"]
        # before Lightning kept it, the configuration was beside the stage
        config = about.get("config") or raw[HYPER_PARAMETERS]
        state = {
            name.removeprefix(MODEL_PREFIX): value
            for name, value in state.items()
            if name.startswith(MODEL_PREFIX) and isinstance(value, Tensor)
        }
        epochs, steps = _progress(raw)
        resumable = all(raw.get(name) for name in RESUME_KEYS)
        fields = {"stage": str(about["stage"]), "version": str(about["version"])}
    except (AttributeError, KeyError, TypeError, ValueError, IndexError):
        raise InputError(
            f"checkpoint={path}: was not written by occdetr.train; give one that was"
        ) from None
    progress = {"epochs": epochs, "steps": steps, "resumable": resumable}
    return config, {**fields, **progress, "model_state": state}


def _read_released(path: Path, file: Path) -> tuple[Any, dict[str, Any]]:
    """The same for a released model, which cannot be resumed."""
    try:
        about, state = read_released(file)
        config = about["config"]
        fields = {key: str(about[key]) for key in ("stage", "version")}
    except Exception as error:
        raise InputError(
            f"checkpoint={path}: not a readable model ({type(error).__name__}): download it or "
            "export it again"
        ) from error
    return config, {**fields, "model_state": state}


def check_weights(path: Path, state: Mapping[str, Tensor], size: int) -> None:
    """Raises ``InputError`` if a weight is no plain array, or not finite, and if the weights would
    take more memory than their file has bytes (``size``): a view can repeat one number."""
    for name, value in state.items():
        if not _is_plain(value):
            kind = str(value.dtype).removeprefix("torch.")
            raise InputError(
                f"checkpoint={path}: {name} is no plain array of numbers ({kind}): use another file"
            )
    if sum(value.nbytes for value in state.values()) > size:
        raise InputError(f"checkpoint={path}: has fewer weights than it says: give another file")
    for name, value in state.items():
        if not torch.isfinite(value).all():
            raise InputError(
                f"checkpoint={path}: {name} is not finite: its training diverged: give an earlier "
                "checkpoint, or train again with a lower optimizer.lr"
            )


def _is_plain(value: Tensor) -> bool:
    if value.is_nested or value.layout != torch.strided or value.device.type != "cpu":
        return False
    extent = math.prod(size or 1 for size in value.shape)  # PyTorch fails on some of the others
    return value.dtype in PLAIN_TYPES and value.ndim <= MOST_AXES and extent <= MOST_VALUES


def _progress(raw: dict[str, Any]) -> tuple[int, int]:
    """Epochs and steps that a checkpoint has behind it; of older files some do not say."""
    if not raw.get("loops"):
        return 0, 0
    epochs = raw["loops"]["fit_loop"]["epoch_progress"]["current"]["processed"]
    return int(epochs), int(raw["global_step"])


def check_archive(path: Path) -> None:
    """What ``torch.load`` does not look for: a part of the file that is damaged, or compressed.

    ``torch.save`` does not compress, and a small file could fill the memory. Raises ``ValueError``.
    """
    with zipfile.ZipFile(path) as archive:
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise ValueError("compressed")
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"{damaged} is damaged")


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


def check_targets(checkpoint: Checkpoint, config: Mapping[str, Any]) -> None:
    """Raises ``InputError`` if the network, stage or data of a checkpoint name a class that neither
    this package allows (``instantiate.ALLOWED``) nor the user's own ``config`` names."""
    nodes = [checkpoint.config.get(name) for name in ("model", "module", "data")]
    for target in sorted(targets_of(nodes) - targets_of(config)):
        try:
            allowed_class(target)
        except InputError as error:
            raise InputError(f"checkpoint={checkpoint.path}: {error}") from error


def load_initial(model: nn.Module, checkpoint: Checkpoint) -> str:
    """Load the weights with which a training starts; what was loaded and what was not, as text.

    Of a pretraining only the parts that it trains. What is not in the checkpoint keeps its initial
    values.

    Raises ``InputError`` if a weight has another shape, or if one of the parts that a pretraining
    trains is not there as a whole.
    """
    state = checkpoint.model_state
    if checkpoint.stage == "pretrain":
        state = {name: value for name, value in state.items() if _part(name) in PRETRAINED}
    own = model.state_dict()
    shared = {name: value for name, value in state.items() if name in own}
    check_shapes(own, shared, f"init_from={checkpoint.path}")
    new, unused = _parts(own.keys() - shared.keys()), _parts(state.keys() - shared.keys())
    lacking = [name for name in own if name not in shared and _part(name) in PRETRAINED]
    if lacking:
        raise InputError(
            f"init_from={checkpoint.path}: it lacks {len(lacking)} weights of the "
            f"{_part(lacking[0])}, first {lacking[0]}: give a whole checkpoint of the same "
            "partition, or init_from=scratch"
        )
    model.load_state_dict(shared, strict=False)
    text = f"loaded {len(shared)} tensors ({_counted(_parts(shared))})"
    text += f"; new: {_counted(new)}" if new else ""
    return text + (f"; not used: {_counted(unused)}" if unused else "")


def load_exactly(model: nn.Module, checkpoint: Checkpoint) -> None:
    """Load a model's own checkpoint. Raises InputError when a weight is missing or does not fit."""
    own, state = model.state_dict(), checkpoint.model_state
    for names, what in ((own.keys() - state.keys(), "missing"), (state.keys() - own, "unknown")):
        if names:
            raise InputError(
                f"checkpoint={checkpoint.path}: does not fit the model ({len(names)} weights "
                f"{what}, first {min(names)}); use it with the model it was trained with"
            )
    check_shapes(own, state, f"checkpoint={checkpoint.path}")
    model.load_state_dict(state)


def check_shapes(own: dict[str, Tensor], state: dict[str, Tensor], setting: str) -> None:
    """Raises ``InputError`` if a weight in ``state`` has another shape than in ``own``."""
    wrong = [name for name, value in state.items() if value.shape != own[name].shape]
    if wrong:
        shapes = [list(tensors[wrong[0]].shape) for tensors in (state, own)]
        raise InputError(
            f"{setting}: {len(wrong)} weights have another shape, first {wrong[0]}: {shapes[0]} "
            f"there, {shapes[1]} in this model; use the model it was trained with"
        )


def _part(name: str) -> str:
    return name.split(".")[0]


def _parts(names: Iterable[str]) -> Counter[str]:
    return Counter(map(_part, names))


def _counted(parts: Counter[str]) -> str:
    return ", ".join(f"{name} ({count})" for name, count in sorted(parts.items()))
