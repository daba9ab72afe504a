"""The checkpoints of a run: ``last.ckpt``, the one before it, and ``best.ckpt``."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint

from occdetr.data.train_position import TrainPosition
from occdetr.errors import InputError
from occdetr.files import replacing
from occdetr.training.stop_signals import StopSignals

LAST, PREVIOUS, BEST = "last.ckpt", "last-previous.ckpt", "best.ckpt"


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the goal, then renames: a crash leaves the old checkpoint or the new one.

    The ``last.ckpt`` that is replaced stays as ``last-previous.ckpt``.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        goal = Path(path)
        with replacing(goal) as temporary:
            with temporary.open("wb") as file:
                torch.save(checkpoint, file)
                file.flush()
                os.fsync(file.fileno())  # whole on the disk before it takes the other's name
            if goal.name == LAST and goal.is_file():
                keep_as(goal, goal.with_name(PREVIOUS))


def keep_as(file: Path, other: Path) -> None:
    """Give a file's content a second name, replacing what had it; there is always one of both."""
    with replacing(other) as temporary:
        try:
            os.link(file, temporary)
        except OSError:  # a file system without hard links
            shutil.copyfile(file, temporary)


class LastCheckpoint(Checkpoint):
    """Writes ``last.ckpt`` after each epoch, in the middle of one, and when a signal stops the run.

    Between two optimizer steps a checkpoint holds all that the run depends on, so that when it is
    written changes no result. With random numbers in the network (dropout) they continue too; the
    state is the main process's.

    After SIGTERM or SIGUSR1 to one of the processes, all write it at the same step and end with
    ``StoppedBySignal``.

    Args:
        folder: where; None: the Trainer's ``default_root_dir``.
        every_minutes: of training, after which one is written; None: at the end of epochs only.
        every_steps: the same in optimizer steps.
    """

    def __init__(
        self,
        folder: Path | None = None,
        every_minutes: float | None = 10.0,
        every_steps: int | None = None,
    ) -> None:
        for name, value in (("every_minutes", every_minutes), ("every_steps", every_steps)):
            if value is not None and value <= 0:
                raise InputError(f"callbacks.checkpoint.{name}={value}: give more than 0, or null")
        self.folder = folder
        self.every_minutes = every_minutes
        self.every_steps = every_steps
        self.written = time.monotonic()
        self.random_state: dict[str, Any] = {}
        self.signals = StopSignals()

    def on_train_start(self, trainer: Any, module: Any) -> None:
        self.written = time.monotonic()
        self.signals.watch(trainer)
        if self.random_state:
            restore_random_state(self.random_state)

    def on_train_batch_end(self, trainer: Any, module: Any, *args: Any) -> None:
        if not between_steps(trainer):
            return
        stopped_by = self.signals.agreed(trainer)
        if self._is_due(trainer) or stopped_by:
            self.write(trainer)
        if stopped_by:
            self.signals.stop(stopped_by)

    def on_train_epoch_end(self, trainer: Any, module: Any) -> None:
        self.write(trainer)
        stopped_by = self.signals.agreed(trainer)
        if stopped_by and not trainer.fit_loop.done:
            self.signals.stop(stopped_by)

    def write(self, trainer: Any) -> None:
        """Called by all processes."""
        if not trainer.fast_dev_run:
            trainer.save_checkpoint(Path(self.folder or trainer.default_root_dir) / LAST)
            self.written = time.monotonic()

    def _is_due(self, trainer: Any) -> bool:
        by_steps = self.every_steps is not None and trainer.global_step % self.every_steps == 0
        if by_steps or self.every_minutes is None:
            return by_steps
        due = time.monotonic() - self.written >= 60 * self.every_minutes
        return bool(trainer.strategy.broadcast(due)) if trainer.world_size > 1 else due

    def state_dict(self) -> dict[str, Any]:
        return {"random_state": random_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.random_state = state_dict["random_state"]

    def on_load_checkpoint(self, trainer: Any, module: Any, checkpoint: dict[str, Any]) -> None:
        """Count the batches of the current epoch in this run's size (see ``TrainPosition``)."""
        data, loops = trainer.datamodule, checkpoint["loops"]["fit_loop"]
        if not hasattr(data, "position"):
            return
        if type(data).__qualname__ not in checkpoint:  # older versions: at the end of an epoch
            data.position = TrainPosition(loops["epoch_progress"]["current"]["processed"])
        current = loops["epoch_loop.batch_progress"]["current"]
        shift = data.position.batches - current["processed"] if data.position.frames else 0
        for name in current:
            current[name] += shift


def between_steps(trainer: Any) -> bool:
    """Whether a batch that has just ended is followed by another one and nothing in between.

    No gradients are being accumulated, and neither a validation nor the end of the epoch is next:
    Lightning would leave them out of a run resumed from there.
    """
    loop = trainer.fit_loop.epoch_loop
    if loop._should_accumulate() or loop._num_ready_batches_reached():
        return False
    overfits = trainer.overfit_batches > 0  # Lightning then takes the sampler away
    return not overfits and not loop._should_check_val_fx(trainer.fit_loop._data_fetcher)


def random_state() -> dict[str, Any]:
    """The state of torch's generators, on the CPU and the GPU."""
    state: dict[str, Any] = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def restore_random_state(state: dict[str, Any]) -> None:
    torch.set_rng_state(state["cpu"].cpu())
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"].cpu())


class RunCheckpoint(ModelCheckpoint):
    """``best.ckpt``, written whenever a validation raises ``monitor``.

    A resumed run has a folder of its own, into which the best so far was copied: unlike a
    ``ModelCheckpoint`` this one goes on from it. As a class of its own it has a state of its own
    beside a ``ModelCheckpoint`` of the user's that monitors the same figure.
    """

    def __init__(self, folder: Path, monitor: str) -> None:
        super().__init__(
            dirpath=folder,
            filename=Path(BEST).stem,
            monitor=monitor,
            mode="max",
            save_on_train_epoch_end=False,
            enable_version_counter=False,
            auto_insert_metric_name=False,
        )
        self.path = Path(str(self.dirpath)) / BEST

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the score from the copied file, which may be newer than the checkpoint."""
        if not self.path.is_file():
            return
        best = torch.load(self.path, map_location="cpu", weights_only=True)
        score = best["callbacks"][self.state_key]["best_model_score"]
        self.best_model_path = self.kth_best_model_path = str(self.path)
        self.best_model_score = self.current_score = self.kth_value = score
        self.best_k_models = {str(self.path): score}
