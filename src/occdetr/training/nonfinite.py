"""Stopping a training at its first loss or gradient that is not finite."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.plugins.precision import MixedPrecision
from torch import Tensor
from torch import distributed as dist

from occdetr.errors import NonFiniteError
from occdetr.structures import SceneBatch

FILE = "nonfinite.ckpt"  # in the run's folder
KEY = "nonfinite"  # what was found, in that file


@dataclass(frozen=True)
class LossTerms:
    """The losses of a batch by name: of this rank, and the mean over all ranks."""

    names: list[str]
    own: Tensor
    of_ranks: Tensor


@dataclass
class SeenBatch:
    """A batch since the last step of the optimizer, and the random state before it."""

    index: int
    frame_ids: list[str]
    random_state: dict[str, Tensor]
    terms: LossTerms | None = None

    def describe(self) -> dict[str, Any]:
        """As it is kept in the file: values that ``torch.load(weights_only=True)`` reads."""
        values = {} if self.terms is None else dict(self.named_losses())
        return {
            "batch_idx": self.index,
            "frame_ids": list(self.frame_ids),
            "losses": values,
            "random_state": self.random_state,
        }

    def named_losses(self) -> list[tuple[str, float]]:
        assert self.terms is not None
        return list(zip(self.terms.names, self.terms.own.float().tolist(), strict=True))


class NonFiniteStop(Callback):
    """Ends a training before a loss or gradient that is not finite changes the weights.

    It raises ``NonFiniteError`` on all ranks, with what was found, in which frames. Weights,
    optimizer, frames and random state are left in ``nonfinite.ckpt`` in the folder of the
    checkpoints, a checkpoint that also has the key ``nonfinite``. A gradient scaler
    (``trainer.precision=16-mixed``) skips the steps of gradients that overflow; there only the loss
    counts. It waits for the device once in a step of the optimizer.
    """

    def __init__(self) -> None:
        self.batches: list[SeenBatch] = []
        self.found: dict[str, Any] | None = None

    def on_train_start(self, trainer: lightning.Trainer, module: Any) -> None:
        self.batches, self.found = [], None

    def on_train_batch_start(
        self, trainer: lightning.Trainer, module: Any, batch: SceneBatch, batch_idx: int
    ) -> None:
        self.batches.append(SeenBatch(batch_idx, batch.frame_ids, random_state(module.device)))

    def on_before_backward(self, trainer: lightning.Trainer, module: Any, loss: Tensor) -> None:
        self.batches[-1].terms = module.terms

    def on_before_optimizer_step(
        self, trainer: lightning.Trainer, module: Any, optimizer: Any
    ) -> None:
        parts = [seen.terms.of_ranks for seen in self.batches if seen.terms is not None]
        if not _scales_gradients(trainer):
            gradients = [p.grad for p in module.parameters() if p.grad is not None]
            parts.append(torch.nn.utils.get_total_norm(gradients)[None])
        values = torch.cat([part.float() for part in parts]).tolist()
        if not all(map(math.isfinite, values)):
            self._stop(trainer, module)
        self.batches.clear()

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, module: Any, checkpoint: dict[str, Any]
    ) -> None:
        if self.found is not None:
            checkpoint[KEY] = self.found

    def _stop(self, trainer: lightning.Trainer, module: Any) -> NoReturn:
        """Write the file and raise, on all ranks."""
        batches = _of_all_ranks([seen.describe() for seen in self.batches])
        term, value, frames = _first_non_finite(batches, module)
        step = trainer.global_step + 1
        self.found = {
            "term": term,
            "step": step,
            "epoch": trainer.current_epoch,
            "batches": batches,
        }
        path = _folder(trainer) / FILE
        trainer.save_checkpoint(path)  # a barrier at its end: no rank leaves before it is written
        settings = module.optimizer_settings
        remedy = f"lower optimizer.lr (now {settings.lr:g})"
        if settings.matrix_lr:
            remedy += f" or optimizer.matrix_lr (now {settings.matrix_lr:g})"
        if trainer.precision != "32-true":
            remedy += f", or use trainer.precision=32-true (now {trainer.precision})"
        raise NonFiniteError(
            f"step {step}, epoch {trainer.current_epoch}: {term} is {value} in the frames "
            f"{', '.join(frames)}: {remedy}; the state before this step is in {path}"
        )


def random_state(device: torch.device) -> dict[str, Tensor]:
    """What the network's dropout depends on."""
    states = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(device)
    return states


def _scales_gradients(trainer: lightning.Trainer) -> bool:
    plugin = trainer.precision_plugin
    return isinstance(plugin, MixedPrecision) and plugin.scaler is not None


def _of_all_ranks(batches: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The batches of every rank, each with its ``rank``."""
    every: list[Any] = [batches]
    if dist.is_available() and dist.is_initialized():
        every = [None] * dist.get_world_size()
        dist.all_gather_object(every, batches)
    return [{"rank": rank, **batch} for rank, own in enumerate(every) for batch in own]


def _first_non_finite(
    batches: list[dict[str, Any]], module: lightning.LightningModule
) -> tuple[str, float, list[str]]:
    """The name and value of the first loss or gradient that is not finite, and its frames."""
    for batch in batches:
        for name, value in batch["losses"].items():
            if not math.isfinite(value):
                return f"loss {name}", value, batch["frame_ids"]
    frames = [frame for batch in batches for frame in batch["frame_ids"]]
    for name, parameter in module.named_parameters():
        gradient = parameter.grad
        if gradient is not None and not torch.isfinite(gradient).all():
            return f"the gradient of {name}", float(gradient.sum()), frames
    return "the gradient's norm", math.inf, frames


def _folder(trainer: lightning.Trainer) -> Path:
    """Where the run's checkpoints are."""
    callback = trainer.checkpoint_callback
    return Path(getattr(callback, "dirpath", None) or trainer.default_root_dir)
