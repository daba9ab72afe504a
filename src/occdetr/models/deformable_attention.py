"""Multi-scale deformable attention (Zhu et al., Deformable DETR, 2021, equation 3)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.models.layers import AttentionSize
from occdetr.structures import Memory


def deformable_sampling(
    value: Float[Tensor, "batch token head channel"],
    spatial_shapes: list[tuple[int, int]],
    sampling_locations: Float[Tensor, "batch query head level point 2"],
    attention_weights: Float[Tensor, "batch query head level point"],
) -> Float[Tensor, "batch query dim"]:
    """Weighted sum of bilinear samples of ``value`` at normalised ``sampling_locations`` (x, y).

    ``spatial_shapes``: (rows, columns) of each level. Outside of a map its value is zero. Heads are
    concatenated in the result.
    """
    batch, _, heads, channels = value.shape
    queries, points = sampling_locations.shape[1], sampling_locations.shape[4]
    grids = 2.0 * sampling_locations - 1.0
    weights = attention_weights.permute(0, 2, 1, 3, 4).flatten(0, 1)  # B*heads, Q, L, P
    total = None
    maps = value.split([h * w for h, w in spatial_shapes], dim=1)
    for level, ((height, width), level_value) in enumerate(zip(spatial_shapes, maps, strict=True)):
        image = level_value.permute(0, 2, 3, 1).reshape(batch * heads, channels, height, width)
        grid = grids[:, :, :, level].transpose(1, 2).reshape(batch * heads, queries, points, 2)
        sampled = F.grid_sample(image, grid, align_corners=False)  # B*heads, C, Q, P
        part = (sampled * weights[:, None, :, level]).sum(-1)
        total = part if total is None else total + part
    assert total is not None
    return total.reshape(batch, heads * channels, queries).transpose(1, 2)


class DeformableAttention(nn.Module):
    """Each query samples ``num_points`` locations on every level around its reference.

    References are normalised points (x, y) or boxes (cx, cy, w, h); offsets of points are in cells
    of the level, offsets of boxes in half box sizes.
    """

    def __init__(self, size: AttentionSize) -> None:
        super().__init__()
        self.num_heads, self.num_levels = size.num_heads, size.num_levels
        self.num_points = size.num_points
        hidden_dim = size.hidden_dim
        samples = size.num_heads * size.num_levels * size.num_points
        self.sampling_offsets = nn.Linear(hidden_dim, samples * 2)
        self.attention_weights = nn.Linear(hidden_dim, samples)
        self.value_proj = nn.Linear(hidden_dim, hidden_dim)
        self.output_proj = nn.Linear(hidden_dim, hidden_dim)
        self._initialise()

    def _initialise(self) -> None:
        """Initial offsets: one direction per head, growing distances; uniform weights."""
        angles = torch.arange(self.num_heads) * (2.0 * math.pi / self.num_heads)
        directions = torch.stack([angles.cos(), angles.sin()], -1)
        directions = directions / directions.abs().amax(-1, keepdim=True)
        steps = torch.arange(1, self.num_points + 1, dtype=torch.float32)
        offsets = directions[:, None, None] * steps[None, None, :, None]
        with torch.no_grad():
            offsets = offsets.expand(-1, self.num_levels, -1, -1)
            self.sampling_offsets.bias.copy_(offsets.reshape(-1))
        nn.init.zeros_(self.sampling_offsets.weight)
        nn.init.zeros_(self.attention_weights.weight)
        nn.init.zeros_(self.attention_weights.bias)
        for projection in (self.value_proj, self.output_proj):
            nn.init.xavier_uniform_(projection.weight)
            nn.init.zeros_(projection.bias)

    def forward(
        self,
        query: Float[Tensor, "batch query dim"],
        reference: Float[Tensor, "batch query coordinate"],
        memory: Memory,
    ) -> Float[Tensor, "batch query dim"]:
        batch, queries, _ = query.shape
        heads, levels, points = self.num_heads, self.num_levels, self.num_points
        value = self.value_proj(memory.tokens).unflatten(-1, (heads, -1))
        offsets = self.sampling_offsets(query).view(batch, queries, heads, levels, points, 2)
        weights = self.attention_weights(query).view(batch, queries, heads, levels * points)
        weights = weights.softmax(-1).view(batch, queries, heads, levels, points)
        center = reference[:, :, None, None, None, :2]
        if reference.shape[-1] == 2:
            cells = [[w, h] for h, w in memory.shapes]
            scale = 1.0 / torch.tensor(cells, dtype=query.dtype, device=query.device)[:, None]
        else:
            scale = reference[:, :, None, None, None, 2:] * (0.5 / points)
        sampled = deformable_sampling(value, memory.shapes, center + offsets * scale, weights)
        return self.output_proj(sampled)
