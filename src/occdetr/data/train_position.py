"""Where a training is in its data: what a run needs to continue in the middle of an epoch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class TrainPosition:
    """``epoch`` from 0; ``frames`` of it that all processes together have trained on, which are
    ``batches`` of this run (a resumed run may have another batch size than the one before)."""

    epoch: int = 0
    frames: int = 0
    batches: int = 0


def position_of(trainer: Any, start: TrainPosition, frames_a_step: int) -> TrainPosition:
    """The position of a ``lightning.Trainer`` that has started at ``start``.

    Right in the hooks that write checkpoints: the end of a batch, a validation or an epoch.
    """
    epochs = trainer.fit_loop.epoch_progress.current
    batches = trainer.fit_loop.epoch_loop.batch_progress.current.processed
    if epochs.processed == epochs.started:  # between two epochs
        return TrainPosition(epochs.processed)
    begun = start if epochs.processed == start.epoch else TrainPosition()
    frames = begun.frames + (batches - begun.batches) * frames_a_step
    return TrainPosition(epochs.processed, frames, batches)
