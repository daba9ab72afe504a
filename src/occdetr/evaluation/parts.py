"""What each part of a network costs: time, multiply-adds and bytes.

Parts are watched where their forward pass begins and ends, whatever they do inside.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from rich.progress import track
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.hooks import RemovableHandle

from occdetr.evaluation.speed import mac_counter, summary, synchronized_time
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import SceneBatch

WHOLE, REST = "whole", "rest"


@dataclass(frozen=True)
class Cost:
    """What a computation takes on any device.

    ``least_bytes``: its inputs, parameters, buffers and outputs, each read or written once. No
    program that keeps nothing in a cache from call to call moves fewer; what lies between the
    operators is left out, since fused operators need not write it. ``operator_bytes``: the inputs
    and outputs of every operator instead, which is what unfused operators move.
    """

    macs: int
    least_bytes: int
    operator_bytes: int


@contextlib.contextmanager
def watched(
    parts: Mapping[str, nn.Module],
    before: Callable[[str], None],
    after: Callable[[str, Any], None],
) -> Iterator[None]:
    """Calls ``before(name)`` and ``after(name, (args, kwargs, output))`` around each forward."""
    handles: list[RemovableHandle] = []
    for name, part in parts.items():

        def begin(_module: nn.Module, _args: Any, name: str = name) -> None:
            before(name)

        def end(_module: nn.Module, *values: Any, name: str = name) -> None:
            after(name, values)

        handles.append(part.register_forward_pre_hook(begin))
        handles.append(part.register_forward_hook(end, with_kwargs=True))
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def parts_of(model: nn.Module) -> dict[str, nn.Module]:
    """The parts of the overview figure, in the order in which they run."""
    return dict(model.named_children())


def time_parts(
    model: OccupancyDETR,
    function: Callable[[], Any],
    device: torch.device,
    *,
    repeats: int,
    warmup: int,
) -> tuple[dict[str, dict[str, Any]], float]:
    """Latency of each part of ``model`` within ``function()``, as ``speed.summary`` gives it; of
    the ``rest``, and of the ``whole``. The parts and the rest of each call add up to its whole.

    Also returns CPU time / wall time over all calls: about the number of threads, if nothing else
    uses the cores.
    """
    calls: list[Counter[str]] = []
    began: dict[str, float] = {}

    def before(name: str) -> None:
        began[name] = synchronized_time(device)

    def after(name: str, _values: Any) -> None:
        calls[-1][name] += synchronized_time(device) - began[name]  # pyright: ignore

    rounds = range(-max(warmup, 1), max(repeats, 2))
    wall = cpu = 0.0
    with watched(parts_of(model), before, after):
        for number in track(rounds, description="parts", transient=True):
            calls.append(Counter())
            start, cpu_start = synchronized_time(device), time.process_time()
            function()
            whole = synchronized_time(device) - start
            rest = whole - sum(calls[-1].values())
            calls[-1].update({REST: rest, WHOLE: whole})  # pyright: ignore
            if number < 0:
                calls.pop()
            else:
                wall, cpu = wall + whole, cpu + time.process_time() - cpu_start
    return {name: summary([call[name] for call in calls]) for name in calls[0]}, cpu / wall


def count_parts(model: OccupancyDETR, batch: SceneBatch) -> dict[str, Cost]:
    """The cost of each part of ``model`` in a prediction of ``batch``, and of the ``whole``."""
    with frozen(model), CostMeter(parts_of(model)) as meter:
        _, grid = model.predict(batch)
    io = tensor_bytes([batch.images, batch.camera, state_of(model), grid])
    return {**meter.parts, WHOLE: dataclasses.replace(meter.total(), least_bytes=io)}


class CostMeter:
    """Counts what is computed while it is entered, by part, and in total."""

    def __init__(self, parts: Mapping[str, nn.Module]) -> None:
        self.parts: dict[str, Cost] = {}
        self._modules = parts
        self._counter, self._traffic = mac_counter(), _OperatorBytes()
        self._began: dict[str, Cost] = {}
        self._open = contextlib.ExitStack()

    def __enter__(self) -> CostMeter:
        self._open.enter_context(self._counter)
        self._open.enter_context(self._traffic)
        self._open.enter_context(watched(self._modules, self._before, self._after))
        return self

    def __exit__(self, *exception: Any) -> None:
        self._open.__exit__(*exception)

    def total(self) -> Cost:
        """What has been computed so far; ``least_bytes`` of the parts alone."""
        least = sum(cost.least_bytes for cost in self.parts.values())
        return Cost(self._counter.get_total_flops() // 2, least, self._traffic.total)

    def _before(self, name: str) -> None:
        self._began[name] = self.total()

    def _after(self, name: str, values: Any) -> None:
        cost = difference(self.total(), self._began[name])
        least = tensor_bytes([values, state_of(self._modules[name])])
        self.parts[name] = dataclasses.replace(cost, least_bytes=least)


def difference(after: Cost, before: Cost) -> Cost:
    """The cost of what has been computed between two totals."""
    pairs = zip(dataclasses.astuple(after), dataclasses.astuple(before), strict=True)
    return Cost(*(late - early for late, early in pairs))


class _OperatorBytes(TorchDispatchMode):
    """Adds up the inputs and outputs of every operator that is more than a view."""

    def __init__(self) -> None:
        super().__init__()
        self.total = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        output = func(*args, **(kwargs or {}))
        if not func.is_view:
            self.total += tensor_bytes([args, kwargs]) + tensor_bytes(output)
        return output


@contextlib.contextmanager
def frozen(model: nn.Module) -> Iterator[None]:
    """No parameter is trainable: the counter's hooks fail on such under ``no_grad``."""
    trainable = [parameter for parameter in model.parameters() if parameter.requires_grad]
    model.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)


def state_of(module: nn.Module) -> list[Tensor]:
    """Parameters and buffers."""
    return [*module.parameters(), *module.buffers()]


def tensor_bytes(value: Any) -> int:
    """Bytes of the tensors in ``value``, each counted once; of an expanded one those stored."""
    sizes = {}
    for tensor in _tensors(value):
        stored = tensor.untyped_storage().nbytes()
        sizes[id(tensor)] = min(tensor.numel() * tensor.element_size(), stored)
    return sum(sizes.values())


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        yield from _tensors(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _tensors(item)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield from _tensors([getattr(value, field.name) for field in dataclasses.fields(value)])
