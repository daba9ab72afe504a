"""Image features at the projection of a 3D cell's centre, from every level.

After MonoScene's features line of sight projection (Cao and de Charette, 2022).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.models.deformable_attention import deformable_sampling
from occdetr.structures import Memory

#: The values of one level, of a single head, and its (rows, columns).
LevelValues = tuple[Float[Tensor, "batch _ 1 width"], tuple[int, int]]


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

    def maps(self, memory: Memory) -> list[LevelValues]:
        """The projected levels, which can be sampled any number of times."""
        value = self.value_proj(memory.tokens)[:, :, None]
        parts = value.split([rows * columns for rows, columns in memory.shapes], dim=1)
        return list(zip(parts, memory.shapes, strict=True))

    def forward(
        self, maps: list[LevelValues], points: Float[Tensor, "batch query 2"], kind: int
    ) -> Float[Tensor, "batch query dim"]:
        """``points`` (x, y) are normalised to the image."""
        locations = points[..., None, None, None]
        weights = torch.ones_like(locations[:, :, 0])
        seen = [deformable_sampling(part, [shape], locations, weights) for part, shape in maps]
        return self.output_projs[kind](torch.cat(seen, dim=-1))
