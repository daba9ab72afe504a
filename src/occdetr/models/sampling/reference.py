"""The reference form of multi-scale bilinear sampling, from PyTorch's own operators."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def deformable_sampling_reference(
    value: Float[Tensor, "batch token head channel"],
    spatial_shapes: list[tuple[int, int]],
    sampling_locations: Float[Tensor, "batch query 2 head level point"],
    attention_weights: Float[Tensor, "batch query head level point"],
) -> Float[Tensor, "batch query dim"]:
    """What ``deformable_attention.deformable_sampling`` describes, by ``grid_sample``."""
    batch, _, heads, channels = value.shape
    queries, points = sampling_locations.shape[1], sampling_locations.shape[5]
    grids = 2.0 * sampling_locations.movedim(2, -1) - 1.0
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
