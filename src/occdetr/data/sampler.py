"""The frames of each rank and their order."""

from __future__ import annotations

from collections.abc import Iterator, Sized
from typing import Any

import numpy as np
from torch.utils.data import Sampler


class FrameSampler(Sampler[Any]):
    """The frames of one rank.

    With ``shuffle`` (training), the order depends on ``seed`` and epoch. Indices are (epoch,
    index), so that augmentation differs between epochs, and all ranks get the same number of
    frames, for which the first ones may be repeated. Without, a rank gets every ``world_size``-th
    frame in order, so each frame is evaluated exactly once.

    ``start_at`` makes an epoch start behind its first frames, for a run that is resumed in the
    middle of an epoch. The length stays that of a whole epoch, as Lightning counts its batches.
    """

    def __init__(
        self, frames: Sized, shuffle: bool, seed: int = 0, rank: int = 0, world_size: int = 1
    ) -> None:
        self.count = len(frames)
        self.shuffle = shuffle
        self.seed = seed
        self.rank = rank
        self.world_size = world_size
        self.epoch = 0
        self.skipped = 0

    def start_at(self, epoch: int, skipped: int) -> None:
        """Start with ``epoch``, without the first ``skipped`` frames (of all ranks together)."""
        self.epoch, self.skipped = epoch, skipped

    def set_epoch(self, epoch: int) -> None:
        """Called by Lightning before each epoch."""
        if epoch != self.epoch:
            self.start_at(epoch, 0)

    def __len__(self) -> int:
        if self.shuffle:
            return self.remaining(0)
        return len(range(self.rank, self.count, self.world_size))

    def __iter__(self) -> Iterator[Any]:
        if not self.shuffle:
            yield from range(self.rank, self.count, self.world_size)
            return
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.count)
        for position in range(self.remaining(self.skipped)):
            index = order[(self.skipped + self.rank + position * self.world_size) % self.count]
            yield self.epoch, int(index)

    def remaining(self, skipped: int) -> int:
        """This rank's number of frames in an epoch without the first ``skipped`` of all ranks."""
        return max(-(-(self.count - skipped) // self.world_size), 0)
