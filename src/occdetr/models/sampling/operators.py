"""Multi-scale bilinear sampling as an operator of PyTorch, which compilers keep whole.

Shapes are given as ``[rows, columns, rows, columns, ...]``, because an operator takes no tuples.
The arithmetic is that of the locations and weights (float32 or float64), whatever the values are.
"""

import importlib.util
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

#: PyTorch's builds for GPUs bring it.
HAS_TRITON = importlib.util.find_spec("triton") is not None


def has_kernel(device: torch.device) -> bool:
    """Whether ``sample`` runs on a device."""
    return device.type == "cpu" or (device.type == "cuda" and HAS_TRITON)


@torch.library.custom_op("occdetr::sample", mutates_args=(), device_types="cpu")
def sample(value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor) -> Tensor:
    """``deformable_attention.deformable_sampling`` by a kernel; the result has the value's dtype.

    Raises ValueError if the sizes of the arguments contradict each other, or a map has no cells.
    """
    from occdetr.models.sampling import cpu  # numba takes a quarter of a second to import

    _check_sizes(value, shapes, locations, weights)
    return cpu.forward(value, shapes, locations, weights)


@torch.library.custom_op("occdetr::sample_backward", mutates_args=(), device_types="cpu")
def sample_backward(
    gradient: Tensor, value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The gradients of value, locations and weights, from that of the result of ``sample``."""
    from occdetr.models.sampling import cpu

    _check_sizes(value, shapes, locations, weights)
    return cpu.backward(gradient, value, shapes, locations, weights)


@sample.register_kernel("cuda")
def _(value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor) -> Tensor:
    from occdetr.models.sampling import triton_kernels

    _check_sizes(value, shapes, locations, weights)
    return triton_kernels.forward(value, shapes, locations, weights)


@sample_backward.register_kernel("cuda")
def _(
    gradient: Tensor, value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    from occdetr.models.sampling import triton_kernels

    _check_sizes(value, shapes, locations, weights)
    return triton_kernels.backward(gradient, value, shapes, locations, weights)


@sample.register_fake
def _(value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor) -> Tensor:
    batch, _, heads, channels = value.shape
    return value.new_empty(batch, locations.shape[1], heads * channels)


@sample_backward.register_fake
def _(
    gradient: Tensor, value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(t.new_empty(t.shape) for t in (value, locations, weights))  # pyright: ignore


def _keep_inputs(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    value, ctx.shapes, locations, weights = inputs
    ctx.save_for_backward(value, locations, weights)


def _differentiate(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    value, locations, weights = ctx.saved_tensors
    to_value, *others = sample_backward(gradient, value, ctx.shapes, locations, weights)
    return to_value, None, *others


sample.register_autograd(_differentiate, setup_context=_keep_inputs)


def _check_sizes(value: Tensor, shapes: Sequence[int], locations: Tensor, weights: Tensor) -> None:
    """The kernels read memory by these sizes, and at least one cell of every map."""
    if min(shapes, default=0) < 1:
        raise ValueError(f"sampling of maps {shapes}: every side must be 1 or more")
    tokens = sum(math.prod(shapes[i : i + 2]) for i in range(0, len(shapes), 2))
    batch, queries, _, heads, levels, points = locations.shape
    expected = [
        (value.shape, (batch, tokens, heads, value.shape[3])),
        (locations.shape, (batch, queries, 2, heads, len(shapes) // 2, points)),
        (weights.shape, (batch, queries, heads, levels, points)),
    ]
    if any(tuple(found) != wanted for found, wanted in expected):
        raise ValueError(
            f"sampling of {list(value.shape)} values at {list(locations.shape)} locations with "
            f"{list(weights.shape)} weights: the sizes do not fit each other or the maps {shapes}"
        )
    if not locations.dtype == weights.dtype in (torch.float32, torch.float64):
        raise ValueError(
            f"locations are {locations.dtype}, weights {weights.dtype}: both must be float32 or "
            "both float64"
        )
