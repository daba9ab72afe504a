"""Image features at the projection of a 3D cell's centre, from every level.

After MonoScene's features line of sight projection (Cao and de Charette, 2022).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.structures import Memory


class LineOfSight(nn.Module):
    """Features of the memory at points of the image, for ``num_kinds`` kinds of queries.

    The memory is projected to ``width`` channels once and sampled bilinearly on every level; a
    linear layer of the query's kind brings the concatenated samples to ``hidden_dim``. Samples
    outside of the image are zero.
    """

    def __init__(self, hidden_dim: int, num_levels: int, width: int, num_kinds: int) -> None:
        super().__init__()
        self.value_proj = nn.Linear(hidden_dim, width)
        self.output_projs = nn.ModuleList(
            nn.Linear(num_levels * width, hidden_dim) for _ in range(num_kinds)
        )

    def maps(self, memory: Memory) -> list[Float[Tensor, "batch width _ _"]]:
        """The projected levels as images, which can be sampled any number of times."""
        value = self.value_proj(memory.tokens).transpose(1, 2)
        parts = value.split([rows * columns for rows, columns in memory.shapes], dim=2)
        return [part.unflatten(2, shape) for part, shape in zip(parts, memory.shapes, strict=True)]

    def forward(
        self,
        maps: list[Float[Tensor, "batch width _ _"]],
        points: Float[Tensor, "batch query 2"],
        kind: int,
    ) -> Float[Tensor, "batch query dim"]:
        """``points`` (x, y) are normalised to the image."""
        grid = (2.0 * points - 1.0)[:, None]
        seen = [F.grid_sample(image, grid, align_corners=False)[:, :, 0] for image in maps]
        return self.output_projs[kind](torch.cat(seen, dim=1).transpose(1, 2))
