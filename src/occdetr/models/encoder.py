"""Backbone maps -> memory: levels of one width, encoded by deformable self-attention."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.errors import BELOW_ONE, CHANNELS, LAYERS, InputError, check_each, check_range
from occdetr.models.deformable_attention import DeformableAttention
from occdetr.models.layers import AttentionSize, FeedForward, sine_encoding
from occdetr.structures import Memory

NORM_GROUPS = 32


class EncoderLayer(nn.Module):
    """Deformable self-attention of the memory, then a feed-forward network."""

    def __init__(self, size: AttentionSize, dropout: float = 0.0) -> None:
        super().__init__()
        self.attention = DeformableAttention(size)
        self.norm = nn.LayerNorm(size.hidden_dim)
        self.feed_forward = FeedForward(size.hidden_dim, size.feedforward_dim, dropout)
        self.dropout = nn.Dropout(dropout)

    def forward(self, memory: Memory, position: Tensor, reference: Tensor, first: int) -> Memory:
        """Tokens before the ``first`` one are attended to, and stay as they are."""
        kept, tokens = memory.tokens[:, :first], memory.tokens[:, first:]
        query = tokens + position[:, first:]
        attended = self.attention(query, reference[:, first:], memory)
        tokens = self.feed_forward(self.norm(tokens + self.dropout(attended)))
        return Memory(torch.cat([kept, tokens], dim=1) if first else tokens, memory.shapes)


class DeformableEncoder(nn.Module):
    """Multi-scale features of the backbone through a deformable encoder (paper III-B).

    ``in_channels`` are those of the backbone's maps. Further levels, up to ``num_levels``, are made
    by stride-2 convolutions of its last map, as in Deformable DETR.

    ``finest_every``: one layer of so many, and the last one, update all levels. The others update
    all but the finest, which has three quarters of the tokens (after Lite DETR, Li et al., 2023).
    1 is Deformable DETR. Raises InputError on values out of range.
    """

    def __init__(
        self,
        in_channels: Sequence[int],
        attention: AttentionSize,
        num_layers: int,
        dropout: float = 0.0,
        finest_every: int = 1,
    ) -> None:
        super().__init__()
        hidden_dim, num_levels = attention.hidden_dim, attention.num_levels
        check_range("model.encoder.num_layers", num_layers, LAYERS)
        check_range("model.encoder.dropout", dropout, BELOW_ONE)
        check_range("model.encoder.finest_every", finest_every, LAYERS)
        check_each("model.encoder.in_channels", in_channels, CHANNELS)
        if finest_every > 1 and num_levels == 1:
            raise InputError(
                f"model.encoder.finest_every={finest_every}: the only level would be left out: "
                "give 1"
            )
        if not 1 <= len(in_channels) <= num_levels:
            raise InputError(
                f"model.encoder.in_channels={list(in_channels)}: give one number for each map of "
                f"the backbone, 1 to attention.num_levels={num_levels} of them"
            )
        if hidden_dim % NORM_GROUPS:
            raise InputError(
                f"attention.hidden_dim={hidden_dim}: give a multiple of {NORM_GROUPS}, "
                "the groups of the encoder's norms"
            )
        self.hidden_dim, self.finest_every = hidden_dim, finest_every
        self.projections = nn.ModuleList(
            nn.Sequential(nn.Conv2d(channels, hidden_dim, 1), nn.GroupNorm(NORM_GROUPS, hidden_dim))
            for channels in in_channels
        )
        extra_channels = [in_channels[-1]] + [hidden_dim] * (num_levels - len(in_channels) - 1)
        self.extra = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(channels, hidden_dim, 3, 2, 1), nn.GroupNorm(NORM_GROUPS, hidden_dim)
            )
            for channels in extra_channels[: num_levels - len(in_channels)]
        )
        self.level_embed = nn.Parameter(torch.randn(num_levels, hidden_dim) * 0.1)
        self.layers = nn.ModuleList(EncoderLayer(attention, dropout) for _ in range(num_layers))

    def forward(self, features: list[Float[Tensor, "batch _ _ _"]]) -> Memory:
        maps = [project(x) for project, x in zip(self.projections, features, strict=True)]
        x = features[-1]
        for project in self.extra:
            x = project(x)
            maps.append(x)
        shapes = [(m.shape[-2], m.shape[-1]) for m in maps]
        memory = Memory(torch.cat([m.flatten(2).transpose(1, 2) for m in maps], dim=1), shapes)
        reference, position = self._references(memory)
        finest = math.prod(shapes[0])
        for following, layer in zip(reversed(range(len(self.layers))), self.layers, strict=True):
            first = finest if following % self.finest_every else 0
            memory = layer(memory, position, reference, first)
        return memory

    def _references(self, memory: Memory) -> tuple[Tensor, Tensor]:
        """Normalised centre of each token, and its position embedding with that of its level."""
        references, positions, like = [], [], memory.tokens
        for level, (rows, columns) in enumerate(memory.shapes):
            y = (torch.arange(rows, device=like.device, dtype=like.dtype) + 0.5) / rows
            x = (torch.arange(columns, device=like.device, dtype=like.dtype) + 0.5) / columns
            grid = torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], dim=-1)
            references.append(grid.flatten(0, 1))
            of_row, of_column = (
                sine_encoding(place[:, None], self.hidden_dim // 4, max_frequency=128.0)
                for place in (y, x)
            )
            of_column = of_column.expand(rows, -1, -1)
            of_row = of_row[:, None].expand(-1, columns, -1)
            position = torch.cat([of_column, of_row], dim=-1) + self.level_embed[level]
            positions.append(position.flatten(0, 1))
        reference = torch.cat(references).expand(len(like), -1, -1)
        return reference, torch.cat(positions)[None]
