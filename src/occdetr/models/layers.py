"""The small parts that the detector, the occupancy decoder and the mask head share."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


class MLP(nn.Sequential):
    """``num_layers`` linear layers with ReLU between them."""

    def __init__(self, in_dim: int, hidden_dim: int, out_dim: int, num_layers: int) -> None:
        dims = [in_dim] + [hidden_dim] * (num_layers - 1) + [out_dim]
        layers: list[nn.Module] = []
        for index in range(num_layers):
            layers += [nn.Linear(dims[index], dims[index + 1]), nn.ReLU()]
        super().__init__(*layers[:-1])


class BoxHead(MLP):
    """An MLP that starts at zero and stays in full precision under autocast.

    In bf16 a log depth of 3 would come in steps of 1.6 %.
    """

    def __init__(self, in_dim: int, hidden_dim: int, out_dim: int, num_layers: int) -> None:
        super().__init__(in_dim, hidden_dim, out_dim, num_layers)
        for parameter in self[-1].parameters():  # what refines something starts by leaving it
            nn.init.zeros_(parameter)

    def forward(self, x: Float[Tensor, "batch query dim"]) -> Float[Tensor, "batch query out"]:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(next(self.parameters()).dtype))


class FeedForward(nn.Module):
    """Residual two-layer network with a layer norm behind it."""

    def __init__(self, hidden_dim: int, feedforward_dim: int) -> None:
        super().__init__()
        self.linear1 = nn.Linear(hidden_dim, feedforward_dim)
        self.linear2 = nn.Linear(feedforward_dim, hidden_dim)
        self.norm = nn.LayerNorm(hidden_dim)

    def forward(self, x: Float[Tensor, "batch query dim"]) -> Float[Tensor, "batch query dim"]:
        return self.norm(x + self.linear2(self.linear1(x).relu()))


class Attention(nn.Module):
    """Multi-head attention with fused kernels; ``key_mask`` is True where a key may be seen."""

    def __init__(self, hidden_dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query_proj = nn.Linear(hidden_dim, hidden_dim)
        self.key_proj = nn.Linear(hidden_dim, hidden_dim, bias=False)  # softmax cancels it
        self.value_proj = nn.Linear(hidden_dim, hidden_dim)
        self.output_proj = nn.Linear(hidden_dim, hidden_dim)

    def forward(
        self,
        query: Float[Tensor, "batch query dim"],
        key: Float[Tensor, "batch key dim"],
        value: Float[Tensor, "batch key dim"],
        key_mask: Tensor | None = None,
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
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.output_proj(attended.transpose(1, 2).flatten(2))


def sine_encoding(
    values: Float[Tensor, "*n d"], num_frequencies: int, max_frequency: float
) -> Float[Tensor, "*n f"]:
    """Sines and cosines of ``values`` (about 0 to 1) at frequencies from 1/2 to ``max_frequency``.

    Frequencies are geometric; ``max_frequency`` counts periods over the unit range, so it says
    which distance is told apart. Returns d * 2 * num_frequencies features.
    """
    exponents = torch.linspace(0, 1, num_frequencies, dtype=values.dtype, device=values.device)
    frequencies = 0.5 * (2.0 * max_frequency) ** exponents
    phases = values[..., None] * (2.0 * math.pi * frequencies)
    return torch.cat([phases.sin(), phases.cos()], dim=-1).flatten(-2)


def take(x: Tensor, indices: Tensor) -> Tensor:
    """Rows of ``x`` [B, N, D] at ``indices`` [B, K] -> [B, K, D]."""
    return x.gather(1, indices[..., None].expand(-1, -1, x.shape[-1]))


def inverse_sigmoid(x: Tensor, epsilon: float = 1e-4) -> Tensor:
    """logit(x), with x kept inside (epsilon, 1 - epsilon)."""
    x = x.clamp(epsilon, 1 - epsilon)
    return torch.log(x / (1 - x))


def class_bias(probability: float = 0.01) -> float:
    """The bias that makes a sigmoid start at ``probability`` (Lin et al., focal loss, 2017)."""
    return -math.log((1 - probability) / probability)
