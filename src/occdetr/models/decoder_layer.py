"""The layer of both decoders: the detector's (paper III-B) and the occupancy's (III-C, Fig. 4)."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor, nn

from occdetr.models.deformable_attention import DeformableAttention, Shapes
from occdetr.models.layers import Attention, FeedForward


class DecoderLayer(nn.Module):
    """Self-attention of the queries, deformable cross-attention to the memory, feed-forward.

    ``key_stride`` s lets every query attend to every s-th query only: a budget for small models.
    """

    def __init__(
        self,
        hidden_dim: int,
        num_heads: int,
        num_levels: int,
        num_points: int,
        feedforward_dim: int,
        key_stride: int = 1,
    ) -> None:
        super().__init__()
        self.key_stride = key_stride
        self.self_attention = Attention(hidden_dim, num_heads)
        self.self_norm = nn.LayerNorm(hidden_dim)
        self.cross_attention = DeformableAttention(hidden_dim, num_heads, num_levels, num_points)
        self.cross_norm = nn.LayerNorm(hidden_dim)
        self.feed_forward = FeedForward(hidden_dim, feedforward_dim)

    def forward(
        self,
        query: Float[Tensor, "batch query dim"],
        position: Float[Tensor, "batch query dim"],
        reference: Tensor,
        memory: Float[Tensor, "batch token dim"],
        shapes: Shapes,
        mask: Bool[Tensor, "batch query"] | None = None,
    ) -> Float[Tensor, "batch query dim"]:
        """``reference`` as ``DeformableAttention`` takes it; ``mask`` is True at queries in use."""
        placed, stride = query + position, self.key_stride
        seen = None if mask is None else mask[:, ::stride]
        attended = self.self_attention(placed, placed[:, ::stride], query[:, ::stride], seen)
        query = self.self_norm(query + attended)
        attended = self.cross_attention(query + position, reference, memory, shapes)
        return self.feed_forward(self.cross_norm(query + attended))
