"""The memory of a computation's tensors."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator
from typing import Any

import torch

MIB = 2**20


def tensor_memory_mb(function: Callable[[], Any], device: torch.device) -> float:
    """MiB: the most that torch's allocator holds at a time during ``function()`` beyond what it
    held before. Unlike the process's memory it is the same in every run.

    On the CPU nothing that ``function`` writes to stderr is seen: call it once before.
    """
    if device.type == "cuda":
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        function()
        return (torch.cuda.max_memory_allocated(device) - before) / MIB
    cpu = [torch.profiler.ProfilerActivity.CPU]
    # the profiler says on stderr when it starts, stops, and meets memory that is older than it
    with _silent_stderr(), torch.profiler.profile(activities=cpu, profile_memory=True) as profile:
        result = function()
    del result
    found: Any = profile.profiler
    events = [each for each in found.kineto_results.events() if each.name() == "[memory]"]
    events.sort(key=lambda event: event.start_ns())
    return max(itertools.accumulate((event.nbytes() for event in events), initial=0)) / MIB


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Nothing is written to the process's stderr, also by libraries."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
