"""Multi-scale bilinear sampling on the CPU: the numba kernels, in PyTorch's number of threads."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from occdetr import use_all_cores
from occdetr.models.sampling import numba_kernels


def forward(value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor) -> Tensor:
    """See ``operators.sample``."""
    batch, _, heads, channels = value.shape
    planes, levels = _planes(value, locations.dtype), _levels(shapes)
    output = locations.new_empty(batch, locations.shape[1], heads, channels)
    arrays = [t.contiguous().flatten(-2).numpy() for t in (locations, weights)]
    _in_threads(
        functools.partial(numba_kernels.forward, planes.numpy(), levels, *arrays, output.numpy()),
        batch * heads,
    )
    return output.flatten(2).to(value.dtype)


def backward(
    gradient: Tensor, value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See ``operators.sample_backward``."""
    batch, tokens, heads, channels = value.shape
    planes, levels = _planes(value, locations.dtype), _levels(shapes)
    given = gradient.to(locations.dtype).unflatten(2, (heads, channels))
    to_planes = torch.zeros_like(planes)
    inputs = [t.contiguous().flatten(-2) for t in (locations, weights)]
    to_locations, to_weights = results = [torch.empty_like(t) for t in inputs]
    arrays = [t.numpy() for t in (*inputs, to_planes, *results)]
    _in_threads(
        functools.partial(
            numba_kernels.backward, given.contiguous().numpy(), planes.numpy(), levels, *arrays
        ),
        batch * heads,
    )
    to_value = to_planes.view(batch, heads, tokens, channels).transpose(1, 2)
    return (
        to_value.to(value.dtype).contiguous(),
        to_locations.view_as(locations),
        to_weights.view_as(weights),
    )


def _planes(value: Tensor, dtype: torch.dtype) -> Tensor:
    """(batch * head, token, channel): one head's values side by side, which fit into the cache."""
    return value.to(dtype).transpose(1, 2).contiguous().flatten(0, 1)


def _levels(shapes: Sequence[int]) -> np.ndarray:
    """Rows, columns and first token of each level."""
    sizes = np.array(shapes, dtype=np.int64).reshape(-1, 2)
    ends = sizes.prod(1).cumsum()
    return np.column_stack([sizes, ends - sizes.prod(1)])


def _in_threads(kernel: Callable[[int, int], None], planes: int) -> None:
    """Call ``kernel(first, last)`` on equal parts of the planes, the last in this thread."""
    threads = min(torch.get_num_threads(), planes)
    if threads <= 1:
        kernel(0, planes)
        return
    bounds = [planes * part // threads for part in range(threads + 1)]
    *parts, own = itertools.pairwise(bounds)
    pool = _pool(os.getpid(), threads - 1)
    jobs = [pool.submit(kernel, *part) for part in parts]
    kernel(*own)
    for job in jobs:
        job.result()


@functools.lru_cache(maxsize=1)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """The threads of a process: those of its parent do not live on in a forked one."""
    return ThreadPoolExecutor(threads, "sampling", initializer=use_all_cores)
