"""One layer of the occupancy decoder, and the x 2 upsampling behind it (paper III-C, Fig. 4)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from occdetr.models.deformable_attention import DeformableAttention, Shapes
from occdetr.models.layers import Attention, FeedForward


class OccupancyLayer(nn.Module):
    """Self-attention among all 3D queries, cross-attention to the image, feed-forward.

    ``key_stride`` s lets every query attend to every s-th query only: a budget for small models.
    """

    def __init__(
        self,
        hidden_dim: int,
        num_heads: int,
        num_levels: int,
        num_points: int,
        feedforward_dim: int,
        key_stride: int,
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
        query: Tensor,
        position: Tensor,
        mask: Tensor,
        reference: Tensor,
        memory: Tensor,
        shapes: Shapes,
    ) -> Tensor:
        placed, stride = query + position, self.key_stride
        attended = self.self_attention(
            placed, placed[:, ::stride], query[:, ::stride], mask[:, ::stride]
        )
        query = self.self_norm(query + attended)
        attended = self.cross_attention(query + position, reference, memory, shapes)
        return self.feed_forward(self.cross_norm(query + attended))


class Split(nn.Module):
    """x 2 upsampling: every query becomes the 2 x 2 x 2 children of its box.

    Children are ordered x, y, z with z fastest: child 4 x + 2 y + z of query q stands at 8 q + it.
    """

    def __init__(self, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(hidden_dim, 8 * out_dim)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Float[Tensor, "batch query dim"]) -> Float[Tensor, "batch child out"]:
        children = self.linear(x).unflatten(-1, (8, -1)).flatten(1, 2)
        return self.norm(children)
