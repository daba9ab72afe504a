"""Size and speed: multiply-adds and latency of a network, samples per second of a data loader."""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from rich.progress import track
from torch.utils.data import DataLoader
from torch.utils.flop_counter import (
    FlopCounterMode,
    sdpa_backward_flop_count,
    sdpa_flop_count,
)

from occdetr.structures import SceneBatch


def _attention_flops(
    query: Sequence[int], key: Sequence[int], value: Sequence[int], *_: Any, **__: Any
) -> int:
    return sdpa_flop_count(query, key, value)


def _sampling_flops(*_: Any, out_shape: Sequence[int], **__: Any) -> int:
    return 2 * 4 * math.prod(out_shape)


def _deformable_flops(
    value: Sequence[int], _: Any, __: Any, weights: Sequence[int], **___: Any
) -> int:
    return 2 * 4 * math.prod(weights) * value[-1]


def _attention_backward_flops(
    gradient: Sequence[int],
    query: Sequence[int],
    key: Sequence[int],
    value: Sequence[int],
    *_: Any,
    **__: Any,
) -> int:
    return sdpa_backward_flop_count(gradient, query, key, value)


def _sampling_backward_flops(gradient: Sequence[int], *_: Any, **__: Any) -> int:
    return 2 * _sampling_flops(out_shape=gradient)


def _deformable_backward_flops(_: Any, *forward: Any, **__: Any) -> int:
    return 2 * _deformable_flops(*forward)


def _convolution_backward_flops(
    gradient: Sequence[int],
    source: Sequence[int],
    weight: Sequence[int],
    *settings: Any,
    **__: Any,
) -> int:
    """As many for the gradient of the input, and for that of the weight, as for the output.

    PyTorch's counter takes grouped convolutions for full ones here.
    """
    wanted, transposed = settings[-1], settings[4]
    places = source if transposed else gradient
    forward = 2 * math.prod(places) * math.prod(weight[1:])
    return forward * (wanted[0] + wanted[1])


#: What PyTorch's counter does not know, or counts wrongly, by operator.
FURTHER_FLOPS = {
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _attention_flops,
    torch.ops.aten.grid_sampler_2d: _sampling_flops,
    torch.ops.aten.cudnn_grid_sampler: _sampling_flops,
    torch.ops.occdetr.sample: _deformable_flops,
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward: _attention_backward_flops,
    torch.ops.aten.grid_sampler_2d_backward: _sampling_backward_flops,
    torch.ops.aten.cudnn_grid_sampler_backward: _sampling_backward_flops,
    torch.ops.occdetr.sample_backward: _deformable_backward_flops,
    torch.ops.aten.convolution_backward: _convolution_backward_flops,
}


def macs_of(function: Callable[[], Any]) -> int:
    """Multiply-adds of a call: of convolutions, matrix products, attention (queries x keys for the
    weights and for the values, whatever kernel computes it) and bilinear sampling (4 for a value).

    Elementwise operations, norms and softmax are not counted.
    """
    with mac_counter() as counter:
        function()
    return counter.get_total_flops() // 2


def mac_counter() -> FlopCounterMode:
    """Counts two operations for each of the multiply-adds that ``macs_of`` counts."""
    return FlopCounterMode(display=False, custom_mapping=FURTHER_FLOPS)


def measure_latency(
    function: Callable[[], Any],
    device: torch.device,
    *,
    repeats: int,
    warmup: int,
    description: str = "forward",
) -> dict[str, Any]:
    """Wall-clock time of ``function()``, as ``summary`` gives it.

    It is called ``repeats`` times (at least 2) after ``warmup`` calls (at least 1) that are not
    counted. On a GPU the clock is read after all kernels have finished.
    """
    times = []
    rounds = range(-max(warmup, 1), max(repeats, 2))
    for number in track(rounds, description=description, transient=True):
        start = synchronized_time(device)
        function()
        elapsed = synchronized_time(device) - start
        if number >= 0:
            times.append(elapsed)
    return summary(times)


def measure_alternating(
    functions: Mapping[str, Callable[[], Any]], device: torch.device, *, repeats: int, warmup: int
) -> tuple[dict[str, list[float]], float]:
    """Seconds of each of ``functions`` in every round; a round calls all of them in turn, so that
    whatever else the machine does slows all of them alike. Rounds as in ``measure_latency``.

    Also returns CPU time / wall time over the rounds.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    cpu = 0.0
    for number in track(range(-max(warmup, 1), max(repeats, 2)), description="", transient=True):
        for name, function in functions.items():
            start, cpu_start = synchronized_time(device), time.process_time()
            function()
            elapsed = synchronized_time(device) - start
            if number >= 0:
                times[name].append(elapsed)
                cpu += time.process_time() - cpu_start
    return times, cpu / sum(map(sum, times.values()))


def summary(seconds: Sequence[float]) -> dict[str, Any]:
    """Median, quartiles and minimum, in milliseconds, of at least two times."""
    times = [1000 * value for value in seconds]
    low, median, high = statistics.quantiles(times, n=4, method="inclusive")
    return {
        "latency_ms": round(median, 3),
        "latency_ms_quartiles": [round(low, 3), round(high, 3)],
        "latency_ms_min": round(min(times), 3),
        "repeats": len(times),
    }


def synchronized_time(device: torch.device) -> float:
    """The clock in seconds, after all work on ``device`` has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def measure_loading(
    loader: DataLoader[Any], *, samples: int, repeats: int, warmup: int, description: str
) -> dict[str, Any]:
    """Samples per second and worker of a loader: median and quartiles.

    Each of ``repeats`` rounds (at least 2), after ``warmup`` rounds (at least 1) that are not
    counted, reads ``samples`` samples. With ``warmup`` * ``samples`` at least as large as the data
    set every frame has been read once before the measurement. The loader's sampler must have
    ``set_epoch``.
    """
    batches = _endless(loader)
    rates = []
    rounds = range(-max(warmup, 1), max(repeats, 2))
    for number in track(rounds, description=description, transient=True):
        start, count = time.perf_counter(), 0
        while count < samples:
            count += len(next(batches))
        if number >= 0:
            elapsed = time.perf_counter() - start
            rates.append(count / elapsed / max(loader.num_workers, 1))
    low, median, high = statistics.quantiles(rates, n=4, method="inclusive")
    return {
        "samples_per_second_per_worker": round(median, 2),
        "quartiles": [round(low, 2), round(high, 2)],
        "samples": samples * len(rates),
    }


def _endless(loader: DataLoader[Any]) -> Iterator[SceneBatch]:
    """The batches of one epoch after the other, each epoch with its own order and augmentation."""
    for epoch in itertools.count():
        loader.sampler.set_epoch(epoch)  # pyright: ignore[reportAttributeAccessIssue]
        yield from loader
