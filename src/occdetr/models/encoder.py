"""Backbone maps -> ``memory``: four levels of one width, encoded by deformable self-attention."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.models.deformable_attention import DeformableAttention, Shapes
from occdetr.models.layers import FeedForward, sine_encoding


class EncoderLayer(nn.Module):
    """Deformable self-attention of the memory, then a feed-forward network."""

    def __init__(
        self,
        hidden_dim: int,
        num_heads: int,
        num_levels: int,
        num_points: int,
        feedforward_dim: int,
    ) -> None:
        super().__init__()
        self.attention = DeformableAttention(hidden_dim, num_heads, num_levels, num_points)
        self.norm = nn.LayerNorm(hidden_dim)
        self.feed_forward = FeedForward(hidden_dim, feedforward_dim)

    def forward(
        self, memory: Tensor, position: Tensor, reference: Tensor, shapes: Shapes
    ) -> Tensor:
        attended = self.attention(memory + position, reference, memory, shapes)
        return self.feed_forward(self.norm(memory + attended))


class DeformableEncoder(nn.Module):
    """Paper III-B: multi-scale features of the backbone through a deformable encoder.

    Levels beyond the backbone's are made by stride-2 convolutions of its last map (stride 64).
    """

    def __init__(
        self,
        in_channels: Sequence[int],
        hidden_dim: int,
        num_layers: int,
        num_heads: int,
        num_levels: int,
        num_points: int,
        feedforward_dim: int,
    ) -> None:
        super().__init__()
        self.hidden_dim = hidden_dim
        self.projections = nn.ModuleList(
            nn.Sequential(nn.Conv2d(channels, hidden_dim, 1), nn.GroupNorm(32, hidden_dim))
            for channels in in_channels
        )
        extra_channels = [in_channels[-1]] + [hidden_dim] * (num_levels - len(in_channels) - 1)
        self.extra = nn.ModuleList(
            nn.Sequential(nn.Conv2d(channels, hidden_dim, 3, 2, 1), nn.GroupNorm(32, hidden_dim))
            for channels in extra_channels[: num_levels - len(in_channels)]
        )
        self.level_embed = nn.Parameter(torch.randn(num_levels, hidden_dim) * 0.1)
        self.layers = nn.ModuleList(
            EncoderLayer(hidden_dim, num_heads, num_levels, num_points, feedforward_dim)
            for _ in range(num_layers)
        )

    def forward(
        self, features: list[Float[Tensor, "batch _ _ _"]]
    ) -> tuple[Float[Tensor, "batch token dim"], Shapes]:
        """Return ``memory``, flattened level by level, and the (rows, columns) of each level."""
        maps = [project(x) for project, x in zip(self.projections, features, strict=True)]
        x = features[-1]
        for project in self.extra:
            x = project(x)
            maps.append(x)
        shapes = [(m.shape[-2], m.shape[-1]) for m in maps]
        memory = torch.cat([m.flatten(2).transpose(1, 2) for m in maps], dim=1)
        reference, position = self._references(shapes, memory)
        for layer in self.layers:
            memory = layer(memory, position, reference, shapes)
        return memory, shapes

    def _references(self, shapes: Shapes, like: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised centre of each token and its position embedding (with the level's)."""
        references, levels = [], []
        for level, (rows, columns) in enumerate(shapes):
            y = (torch.arange(rows, device=like.device, dtype=like.dtype) + 0.5) / rows
            x = (torch.arange(columns, device=like.device, dtype=like.dtype) + 0.5) / columns
            grid = torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], dim=-1)
            references.append(grid.flatten(0, 1))
            levels.append(self.level_embed[level].expand(rows * columns, -1))
        reference = torch.cat(references)[None]
        position = sine_encoding(reference, self.hidden_dim // 4, max_frequency=128.0)
        reference = reference.expand(len(like), -1, -1)
        return reference, position + torch.cat(levels)[None]
