"""What a device can do at most, as measured on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from occdetr.evaluation.speed import synchronized_time

REPEATS = 5
COPIED_BYTES = 2**27


@dataclass(frozen=True)
class DeviceLimits:
    """Operations (two for a multiply-add) and bytes, read and written, per second."""

    flops: float
    bandwidth: float

    def least_seconds(self, macs: int, bytes_moved: int) -> float:
        """The shortest time in which the device could compute and move that much (roofline)."""
        return max(2 * macs / self.flops, bytes_moved / self.bandwidth)


def measure_limits(device: torch.device, dtype: torch.dtype) -> DeviceLimits:
    """The rates of one large matrix product in ``dtype`` and of one large copy, the best of five.

    A single layer can be faster: a 3 x 3 convolution may take fewer multiplications than are
    counted (Winograd), and data that stays in a cache need not be copied from memory.
    """
    side = 8192 if device.type == "cuda" else 1536
    left, right = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    product = _best_seconds(lambda: left @ right, device)
    source = torch.ones(COPIED_BYTES // 4, device=device)
    target = torch.zeros_like(source)
    copy = _best_seconds(lambda: target.copy_(source), device)
    return DeviceLimits(flops=2 * side**3 / product, bandwidth=2 * COPIED_BYTES / copy)


def _best_seconds(function: Callable[[], Any], device: torch.device) -> float:
    times = []
    for _ in range(REPEATS + 1):
        start = synchronized_time(device)
        function()
        times.append(synchronized_time(device) - start)
    return min(times[1:])
