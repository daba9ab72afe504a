"""From the cells of one level to those of the next: x 2 along each axis (paper III-C)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from occdetr.models.layers import FeedForward, relu


class Split(nn.Module):
    """x 2 upsampling: every query becomes the 2 x 2 x 2 children of its box.

    Children are ordered as in ``geometry.subdivision``.
    """

    def __init__(self, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(hidden_dim, 8 * out_dim)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Float[Tensor, "batch query dim"]) -> Float[Tensor, "batch child out"]:
        children = self.linear(x).unflatten(-1, (8, -1)).flatten(1, 2)
        return self.norm(children)


class Refinement(nn.Module):
    """The voxels inside of the kept cells, without attention: ``width`` features for each of a
    cell's 8 children, and the logit of its occupancy.

    One hidden layer for all children, since there are hundreds of thousands of voxels.
    """

    def __init__(self, hidden_dim: int, width: int) -> None:
        super().__init__()
        self.feed_forward = FeedForward(hidden_dim, hidden_dim)
        self.split = nn.Linear(hidden_dim, 8 * width)
        self.occupancy = nn.Linear(width, 1)

    def forward(
        self, cells: Float[Tensor, "batch cell dim"]
    ) -> tuple[Float[Tensor, "batch voxel width"], Float[Tensor, "batch voxel"]]:
        children = relu(self.split(self.feed_forward(cells)))
        embedding = children.unflatten(-1, (8, -1)).flatten(1, 2)
        return embedding, self.occupancy(embedding).squeeze(-1)
