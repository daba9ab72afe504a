"""Small modules and functions that the parts of the network share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from occdetr.errors import CHANNELS, InputError, check_ranges


@dataclass(frozen=True)
class AttentionSize:
    """The widths and counts that all attention layers of a network have in common.

    ``num_levels`` is the number of feature levels of the memory, ``num_points`` the number of
    sampling points per head and level of deformable attention, ``feedforward_dim`` the inner width
    of the feed-forward networks. Raises InputError on values out of range.
    """

    hidden_dim: int
    num_heads: int
    num_levels: int
    num_points: int
    feedforward_dim: int

    def __post_init__(self) -> None:
        check_ranges("attention", self, **dict.fromkeys(vars(self), CHANNELS))
        if self.hidden_dim % self.num_heads:
            raise InputError(
                f"attention.hidden_dim={self.hidden_dim}: give a multiple of "
                f"attention.num_heads={self.num_heads}"
            )


def relu(x: Tensor) -> Tensor:
    """ReLU, in place if no gradient is needed.

    The output of a linear layer is a view, and autograd copies a view that is changed in place.
    """
    return x.relu() if torch.is_grad_enabled() else x.relu_()


class ReLU(nn.Module):
    """``relu`` as a module; ``x`` may be overwritten."""

    def forward(self, x: Float[Tensor, "*n dim"]) -> Float[Tensor, "*n dim"]:
        return relu(x)


class MLP(nn.Sequential):
    """``num_layers`` linear layers with ReLU between them."""

    def __init__(self, in_dim: int, hidden_dim: int, out_dim: int, num_layers: int) -> None:
        dims = [in_dim] + [hidden_dim] * (num_layers - 1) + [out_dim]
        layers: list[nn.Module] = []
        for index in range(num_layers):
            layers += [nn.Linear(dims[index], dims[index + 1]), ReLU()]
        super().__init__(*layers[:-1])


class BoxHead(MLP):
    """An MLP whose output starts at zero and which runs in full precision under autocast.

    In bf16 a log depth of 3 would be rounded to steps of 1.6 %.
    """

    def __init__(self, in_dim: int, hidden_dim: int, out_dim: int, num_layers: int) -> None:
        super().__init__(in_dim, hidden_dim, out_dim, num_layers)
        for parameter in self[-1].parameters():  # the first refinement changes nothing
            nn.init.zeros_(parameter)

    def forward(self, x: Float[Tensor, "batch query dim"]) -> Float[Tensor, "batch query out"]:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(next(self.parameters()).dtype))


class FeedForward(nn.Module):
    """Residual two-layer network, followed by a layer norm."""

    def __init__(self, hidden_dim: int, feedforward_dim: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.linear1 = nn.Linear(hidden_dim, feedforward_dim)
        self.linear2 = nn.Linear(feedforward_dim, hidden_dim)
        self.norm = nn.LayerNorm(hidden_dim)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Float[Tensor, "batch query dim"]) -> Float[Tensor, "batch query dim"]:
        inner = self.dropout(relu(self.linear1(x)))
        return self.norm(x + self.dropout(self.linear2(inner)))


class Attention(nn.Module):
    """Multi-head attention through ``scaled_dot_product_attention``.

    ``key_mask`` is True at the keys that queries may attend to. Keys have no bias: the softmax
    cancels it, so it would never get a gradient.
    """

    def __init__(self, hidden_dim: int, num_heads: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.dropout = dropout
        self.query_proj = nn.Linear(hidden_dim, hidden_dim)
        self.key_proj = nn.Linear(hidden_dim, hidden_dim, bias=False)
        self.value_proj = nn.Linear(hidden_dim, hidden_dim)
        self.output_proj = nn.Linear(hidden_dim, hidden_dim)

    def forward(
        self,
        query: Float[Tensor, "batch query dim"],
        key: Float[Tensor, "batch key dim"],
        value: Float[Tensor, "batch key dim"],
        key_mask: Bool[Tensor, "batch key"] | None = None,
    ) -> Float[Tensor, "batch query dim"]:
        q, k, v = (
            projection(x).unflatten(-1, (self.num_heads, -1)).transpose(1, 2)
            for projection, x in (
                (self.query_proj, query),
                (self.key_proj, key),
                (self.value_proj, value),
            )
        )
        mask = None if key_mask is None else key_mask[:, None, None, :].expand(-1, -1, 1, -1)
        dropout = self.dropout if self.training else 0.0
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, dropout_p=dropout)
        return self.output_proj(attended.transpose(1, 2).flatten(2))


class FewQueryAttention(Attention):
    """``Attention`` of few queries to many ``features``, which are keys and values at once.

    The weights and the result are those of ``Attention`` without a mask. But the features are not
    projected: the key projection is applied to the queries, the value projection to the attended
    features. That costs queries x heads for each feature, not twice its width.
    """

    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, query: Float[Tensor, "batch query dim"], features: Float[Tensor, "batch key dim"]
    ) -> Float[Tensor, "batch query dim"]:
        heads = self.num_heads
        key_weight = self.key_proj.weight.unflatten(0, (heads, -1))
        value_weight = self.value_proj.weight.unflatten(0, (heads, -1))
        q = self.query_proj(query).unflatten(-1, (heads, -1)).transpose(1, 2)
        folded = (q * q.shape[-1] ** -0.5 @ key_weight).flatten(1, 2)
        weights = (folded @ features.transpose(1, 2)).softmax(-1)
        attended = weights.to(features.dtype) @ features
        values = attended.unflatten(1, (heads, -1)) @ value_weight.transpose(1, 2)
        values = values.transpose(1, 2).flatten(2) + self.value_proj.bias
        return self.output_proj(values)


def sine_encoding(
    values: Float[Tensor, "*n d"], num_frequencies: int, max_frequency: float
) -> Float[Tensor, "*n f"]:
    """Sines and cosines of ``values`` (about 0 to 1) at frequencies from 1/2 to ``max_frequency``.

    Frequencies are geometric and count periods over the unit range. Returns
    ``f = d * 2 * num_frequencies`` features.
    """
    exponents = torch.linspace(0, 1, num_frequencies, dtype=values.dtype, device=values.device)
    frequencies = 0.5 * (2.0 * max_frequency) ** exponents
    phases = values[..., None] * (2.0 * math.pi * frequencies)
    return torch.cat([phases.sin(), phases.cos()], dim=-1).flatten(-2)


def take(x: Shaped[Tensor, "batch n d"], indices: Int[Tensor, "batch k"]) -> Tensor:
    """The rows [batch, k, d] of ``x`` at ``indices``.

    Whole rows are copied, which takes a fifth of the time of ``gather``. A slice of several frames
    is made contiguous first.
    """
    batch, rows, _ = x.shape
    starts = rows * torch.arange(batch, device=x.device)
    flat = (indices + starts[:, None]).flatten()
    return x.flatten(0, 1).index_select(0, flat).unflatten(0, indices.shape)


def inverse_sigmoid(x: Tensor, epsilon: float = 1e-4) -> Tensor:
    """logit(x), with x clamped to (epsilon, 1 - epsilon)."""
    x = x.clamp(epsilon, 1 - epsilon)
    return torch.log(x / (1 - x))


def class_bias(probability: float = 0.01) -> float:
    """The bias that makes a sigmoid start at ``probability`` (Lin et al., focal loss, 2017)."""
    return -math.log((1 - probability) / probability)


def clamp_inward(x: Float[Tensor, "*n"], bound: float) -> Float[Tensor, "*n"]:
    """``x.clamp(-bound, bound)``, where values beyond a bound keep the gradients that pull them
    back: with ``clamp`` a value that has left the range stays out for ever."""
    return _ClampInward.apply(x, bound)  # pyright: ignore[reportReturnType]


class _ClampInward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, bound: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.bound = bound
        return x.clamp(-bound, bound)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (x,), (gradient,) = ctx.saved_tensors, gradients
        outward = ((x > ctx.bound) & (gradient < 0)) | ((x < -ctx.bound) & (gradient > 0))
        return gradient.masked_fill(outward, 0.0), None
