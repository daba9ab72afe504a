"""The layer of both decoders: the detector's (paper III-B) and the occupancy's (III-C, Fig. 4)."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from occdetr.models.deformable_attention import DeformableAttention
from occdetr.models.layers import Attention, AttentionSize, FeedForward
from occdetr.structures import Memory

KeyChoice = Literal["first", "spread"]
GOLDEN_RATIO = 0.6180339887


class DecoderLayer(nn.Module):
    """Self-attention of the queries, deformable cross-attention to the memory, feed-forward.

    With ``key_stride`` s every query attends to one of s queries only (s = 1: to all), which bounds
    the cost of many queries. ``key_choice``: see ``chosen_keys``.
    """

    def __init__(
        self,
        size: AttentionSize,
        key_stride: int = 1,
        dropout: float = 0.0,
        key_choice: KeyChoice = "first",
    ) -> None:
        super().__init__()
        self.key_stride = key_stride
        self.key_choice: KeyChoice = key_choice
        self.self_attention = Attention(size.hidden_dim, size.num_heads, dropout)
        self.self_norm = nn.LayerNorm(size.hidden_dim)
        self.cross_attention = DeformableAttention(size)
        self.cross_norm = nn.LayerNorm(size.hidden_dim)
        self.feed_forward = FeedForward(size.hidden_dim, size.feedforward_dim, dropout)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        query: Float[Tensor, "batch query dim"],
        position: Float[Tensor, "batch query dim"],
        reference: Float[Tensor, "batch query coordinate"],
        memory: Memory,
        mask: Bool[Tensor, "batch query"] | None = None,
    ) -> Float[Tensor, "batch query dim"]:
        """``reference`` as in ``DeformableAttention``; queries where ``mask`` is False are not
        attended to."""
        placed = query + position
        keys = chosen_keys(query.shape[1], self.key_stride, self.key_choice, query.device)
        seen = None if mask is None else mask[:, keys]
        attended = self.self_attention(placed, placed[:, keys], query[:, keys], seen)
        query = self.self_norm(query + self.dropout(attended))
        attended = self.cross_attention(query + position, reference, memory)
        return self.feed_forward(self.cross_norm(query + self.dropout(attended)))


def chosen_keys(
    count: int, stride: int, choice: KeyChoice, device: torch.device
) -> slice | Int[Tensor, " key"]:
    """The queries that are attended to, one of each ``stride`` in a row.

    "first" takes the first of them. The children of an object follow each other, so these are
    always the same octants: with a stride of 2 the lower ones, with 8 one corner. "spread" takes
    another one in each row, by the golden ratio, so that all octants are seen equally often.
    """
    if choice == "first" or stride == 1:
        return slice(None, None, stride)
    rows = torch.arange(-(-count // stride), device=device)
    offset = ((rows * GOLDEN_RATIO) % 1.0 * stride).long()
    return (rows * stride + offset).clamp(max=count - 1)
