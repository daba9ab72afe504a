"""The memory of a computation's tensors."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from typing import Any

import torch

os.environ.setdefault("KINETO_LOG_LEVEL", "5")  # the profiler would write to stderr

MIB = 2**20


def tensor_memory_mb(function: Callable[[], Any], device: torch.device) -> float:
    """MiB: the most that torch's allocator holds at a time during ``function()`` beyond what it
    held before. Unlike the process's memory it is the same in every run."""
    if device.type == "cuda":
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        function()
        return (torch.cuda.max_memory_allocated(device) - before) / MIB
    with torch.profiler.profile(
        activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True
    ) as profile:
        result = function()
    del result
    found: Any = profile.profiler
    events = [each for each in found.kineto_results.events() if each.name() == "[memory]"]
    events.sort(key=lambda event: event.start_ns())
    return max(itertools.accumulate((event.nbytes() for event in events), initial=0)) / MIB
