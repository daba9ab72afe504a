"""The layer of both decoders: the detector's (paper III-B) and the occupancy's (III-C, Fig. 4)."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor, nn

from occdetr.models.deformable_attention import DeformableAttention
from occdetr.models.layers import Attention, AttentionSize, FeedForward
from occdetr.structures import Memory


class DecoderLayer(nn.Module):
    """Self-attention of the queries, deformable cross-attention to the memory, feed-forward."""

    def __init__(self, size: AttentionSize, dropout: float = 0.0) -> None:
        super().__init__()
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
        keys: Float[Tensor, "batch key dim"] | None = None,
        mask: Bool[Tensor, "batch key"] | None = None,
    ) -> Float[Tensor, "batch query dim"]:
        """``reference`` as in ``DeformableAttention``. The queries attend to ``keys``, by default
        to each other; those where ``mask`` is False are not attended to."""
        placed = query + position
        if keys is None:
            attended = self.self_attention(placed, placed, query, mask)
        else:
            attended = self.self_attention(placed, keys, keys, mask)
        query = self.self_norm(query + self.dropout(attended))
        attended = self.cross_attention(query + position, reference, memory)
        return self.feed_forward(self.cross_norm(query + self.dropout(attended)))
