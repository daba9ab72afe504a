"""Batches on their way from the workers of a loader to its process."""

from __future__ import annotations

import io
import itertools
import pickle
from collections.abc import Callable
from multiprocessing.reduction import ForkingPickler
from typing import Any

import torch
from torch import Tensor

from occdetr.structures import SceneBatch

_ALIGNMENT = 64  # bytes; of every tensor in the block


def share_batches() -> None:
    """Let this process send each ``SceneBatch`` as one block of shared memory.

    PyTorch would send each of its tensors, ten for every frame, through a file and a connection of
    its own, which takes longer than to load the frame.
    """
    ForkingPickler.register(SceneBatch, _reduce)


def _reduce(batch: SceneBatch) -> tuple[Callable[..., SceneBatch], tuple[Any, ...]]:
    structure = io.BytesIO()
    pickler = _WithoutTensors(structure, pickle.HIGHEST_PROTOCOL)
    pickler.dump(batch)
    tensors = pickler.tensors
    sizes = [-(-tensor.nbytes // _ALIGNMENT) * _ALIGNMENT for tensor in tensors]
    *starts, total = itertools.accumulate(sizes, initial=0)
    block = torch.empty(0, dtype=torch.uint8)
    block.set_(torch.UntypedStorage._new_shared(total))  # as torch's own default_collate does
    places = [
        (start, tensor.dtype, tensor.shape) for start, tensor in zip(starts, tensors, strict=True)
    ]
    for tensor, into in zip(tensors, _views(block, places), strict=True):
        into.copy_(tensor)
    return _rebuild, (structure.getvalue(), block, places)


def _rebuild(structure: bytes, block: Tensor, places: list[Any]) -> SceneBatch:
    return _WithTensors(structure, _views(block, places)).load()


def _views(block: Tensor, places: list[Any]) -> list[Tensor]:
    return [
        block[start : start + dtype.itemsize * shape.numel()].view(dtype).view(shape)
        for start, dtype, shape in places
    ]


class _WithoutTensors(pickle.Pickler):
    """Collects the tensors, and writes their numbers in place of them."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.tensors: list[Tensor] = []

    def persistent_id(self, obj: Any) -> int | None:
        if not isinstance(obj, Tensor):
            return None
        self.tensors.append(obj)
        return len(self.tensors) - 1


class _WithTensors(pickle.Unpickler):
    def __init__(self, structure: bytes, tensors: list[Tensor]) -> None:
        super().__init__(io.BytesIO(structure))
        self.tensors = tensors

    def persistent_load(self, pid: int) -> Tensor:
        return self.tensors[pid]
