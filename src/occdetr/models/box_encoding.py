"""The encoding of 3D boxes: sines of their place in the grid and of their log size."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from occdetr.geometry.subdivision import grid_extent
from occdetr.geometry.voxels import GRID_ORIGIN
from occdetr.models.layers import MLP, sine_encoding

NUM_FREQUENCIES = 12  # per coordinate of a box
MAX_FREQUENCY = 96.0  # periods over the grid's extent: resolves cells of 0.4 m
WIDTH = 2 * NUM_FREQUENCIES


class BoxEncoder(nn.Module):
    """Boxes (centre, size) of the grid frame, metres -> features, through an MLP and a layer norm.

    The norm scales the encoding like the content embedding that it is added to.
    """

    def __init__(self, hidden_dim: int) -> None:
        super().__init__()
        self.mlp = MLP(6 * WIDTH, hidden_dim, hidden_dim, 2)
        self.norm = nn.LayerNorm(hidden_dim)

    def forward(self, boxes: Float[Tensor, "batch box 6"]) -> Float[Tensor, "batch box dim"]:
        axes = enumerate(zip(GRID_ORIGIN, grid_extent(), strict=True))
        place = [(boxes[..., axis] - origin) / extent for axis, (origin, extent) in axes]
        values = torch.cat([torch.stack(place, dim=-1), _relative(boxes[..., 3:])], dim=-1)
        return self.norm(self.mlp(_sines(values)))

    def of_cells(
        self, cells: Int[Tensor, "batch cell 3"], shape: tuple[int, int, int]
    ) -> Float[Tensor, "batch cell dim"]:
        """What ``forward`` gives for the boxes of ``cells``, integer coordinates on the grid
        ``shape`` that tiles the space.

        All cells of a grid have one size, and each axis has few places. The first linear layer is
        therefore the sum of a row for each axis, from a table of all places.
        """
        first, *rest = self.mlp
        assert isinstance(first, nn.Linear)
        by_coordinate = first.weight.split(WIDTH, dim=1)
        hidden = first.bias
        for axis, (side, extent) in enumerate(zip(shape, grid_extent(), strict=True)):
            place = (torch.arange(side, device=cells.device, dtype=hidden.dtype) + 0.5) / side
            table = F.linear(_sines(place[:, None]), by_coordinate[axis])
            size = _sines(_relative(place.new_full((1,), extent / side)))
            table = table + F.linear(size, by_coordinate[3 + axis])
            hidden = hidden + F.embedding(cells[..., axis], table)
        return self.norm(nn.Sequential(*rest)(hidden))


def _relative(size: Tensor) -> Tensor:
    """Sizes of 6 cm to 16 m as 0 to 1, by their logarithm."""
    return (size.clamp(min=1e-3).log2() + 4.0) / 8.0


def _sines(values: Tensor) -> Tensor:
    return sine_encoding(values, NUM_FREQUENCIES, MAX_FREQUENCY)
