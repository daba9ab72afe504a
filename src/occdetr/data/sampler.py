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

    def set_epoch(self, epoch: int) -> None:
        """Called by Lightning before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        if self.shuffle:
            return -(-self.count // self.world_size)
        return len(range(self.rank, self.count, self.world_size))

    def __iter__(self) -> Iterator[Any]:
        if not self.shuffle:
            yield from range(self.rank, self.count, self.world_size)
            return
        order = np.random.default_rng([self.seed, self.epoch]).permutation(self.count)
        for position in range(len(self)):
            index = order[(self.rank + position * self.world_size) % self.count]
            yield self.epoch, int(index)
