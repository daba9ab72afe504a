"""Which frames each rank takes, and in what order."""

from __future__ import annotations

from collections.abc import Iterator, Sized
from typing import Any

import numpy as np
from torch.utils.data import Sampler


class FrameSampler(Sampler[Any]):
    """The frames of one rank.

    Training (``shuffle``): a new order each epoch, given by ``seed`` and epoch; indices come as
    (epoch, index), so that augmentation is drawn anew; ranks get equally many frames, the first
    ones twice if need be. Else: every ``world_size``-th frame in order, so that each frame is seen
    by exactly one rank, once.
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
