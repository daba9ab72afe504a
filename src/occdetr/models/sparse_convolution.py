"""A 3 x 3 x 3 convolution among the cells of a level that exist, as in a sparse 3D U-Net.

After the submanifold convolution of Graham and van der Maaten (2017): cells that do not exist
count as zero, and none are added.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from occdetr.geometry.subdivision import all_cells
from occdetr.models.layers import relu, take

NEIGHBOURS = 27  # of a cell, with itself


class SparseConvolution(nn.Module):
    """Adds to the features of every cell what its neighbours know, through ``width`` channels.

    Starts as the identity, so that it can be added to a trained network.
    """

    def __init__(self, hidden_dim: int, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(hidden_dim)
        self.reduce = nn.Linear(hidden_dim, width)
        self.expand = nn.Linear(NEIGHBOURS * width, hidden_dim)
        nn.init.zeros_(self.expand.weight)
        nn.init.zeros_(self.expand.bias)

    def forward(
        self, x: Float[Tensor, "batch cell dim"], neighbours: Int[Tensor, "batch cell 27"]
    ) -> Float[Tensor, "batch cell dim"]:
        """``neighbours``: those of ``neighbour_indices``."""
        inner = relu(self.reduce(self.norm(x)))
        inner = torch.cat([inner, torch.zeros_like(inner[:, :1])], dim=1)  # what does not exist
        seen = take(inner, neighbours.flatten(1))
        return x + self.expand(seen.unflatten(1, neighbours.shape[1:]).flatten(2))


def neighbour_indices(
    cells: Int[Tensor, "batch cell 3"], grid: tuple[int, int, int]
) -> Int[Tensor, "batch cell 27"]:
    """Which of ``cells`` are the neighbours of each, itself in the middle; their number where there
    is none. ``cells`` are different cells of ``grid``."""
    batch, number, _ = cells.shape
    _, height, depth = (side + 2 for side in grid)  # with a border, where nothing exists

    def place(x: Int[Tensor, "*n 3"]) -> Int[Tensor, " *n"]:
        return (x[..., 0] * height + x[..., 1]) * depth + x[..., 2]

    places, steps = place(cells + 1), place(all_cells((3, 3, 3), cells.device) - 1)
    size = (grid[0] + 2) * height * depth
    table = torch.full((batch, size), number, dtype=torch.long, device=cells.device)
    own = torch.arange(number, device=cells.device).expand(batch, -1)
    table = table.scatter(1, places, own)
    around = (places[:, :, None] + steps).flatten(1)
    return table.gather(1, around).unflatten(1, (number, NEIGHBOURS))
