"""``trainer.precision=auto``: bf16 where it is clearly faster on this machine."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import distributed as dist

from occdetr.training.device import computes_bf16

#: bf16 has to be this many times faster in matrix products and convolutions. The rest of a step
#: runs in float32, and casts.
CLEARLY_FASTER = 1.3
REPEATS = 7

#: How a process tells its choice to the ranks that it starts, and to its own next run.
CHOICE = "OCCDETR_PRECISION_{}"


def resolve_precision(precision: Any, accelerator: str) -> Any:
    """``precision``, but for "auto" bf16-mixed or 32-true, with a line that says why.

    ``accelerator`` is a kind of device, such as cpu or cuda, or auto. A GPU gets bf16 if it has
    native matrix products in it. Processors have them that gain nothing, so on a CPU both are timed
    (below half a second). All ranks of a run take the choice of the first one.
    """
    if precision != "auto":
        return precision
    name = CHOICE.format("cuda" if accelerator != "cpu" and torch.cuda.is_available() else "cpu")
    if name not in os.environ:
        os.environ[name] = _choice_of_first_rank(accelerator)
    return os.environ[name]


def _choice_of_first_rank(accelerator: str) -> str:
    if not (dist.is_available() and dist.is_initialized()):
        return _choose(accelerator)
    choice = [_choose(accelerator) if dist.get_rank() == 0 else ""]
    dist.broadcast_object_list(choice)
    return choice[0]


def _choose(accelerator: str) -> str:
    on_gpu = accelerator != "cpu" and torch.cuda.is_available()
    native, speedup = computes_bf16(accelerator), None
    if native and not on_gpu:
        speedup = bf16_speedup()
    chosen = native and (speedup is None or speedup >= CLEARLY_FASTER)
    precision = "bf16-mixed" if chosen else "32-true"
    reason = "native" if native else "not native"
    if speedup is not None:
        reason = f"{speedup:.2f} times as fast as float32"
    print(f"trainer.precision=auto: {precision}: bf16 is {reason} here", flush=True)
    return precision


def bf16_speedup() -> float:
    """The time in float32 by that in bf16 of a linear layer and a convolution of the network's
    sizes, forward and backward, on the CPU."""
    tokens, weight = torch.ones(2048, 128), torch.full((256, 128), 0.01, requires_grad=True)
    image = torch.ones(1, 64, 32, 104)
    kernel = torch.full((64, 64, 3, 3), 0.01, requires_grad=True)

    def work(enabled: bool) -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            linear = F.linear(tokens.requires_grad_(), weight)
            convolved = F.conv2d(image.requires_grad_(), kernel, padding=1)
        torch.autograd.grad([linear.sum(), convolved.sum()], [tokens, weight, image, kernel])

    return median_ratio(lambda: work(False), lambda: work(True))


def median_ratio(
    first: Callable[[], Any],
    second: Callable[[], Any],
    clock: Callable[[], float] = time.process_time,  # other processes do not count
) -> float:
    """The median of the ratios of both times, measured in turn after a warm-up."""
    ratios = []
    for _ in range(REPEATS + 1):
        times = [clock()]
        for function in (first, second):
            function()
            times.append(clock())
        ratios.append((times[1] - times[0]) / max(times[2] - times[1], 1e-9))
    return statistics.median(ratios[1:])
