"""Multi-scale deformable attention (Zhu et al., Deformable DETR, 2021, equation 3)."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.models.layers import AttentionSize
from occdetr.models.sampling.operators import has_kernel, sample
from occdetr.models.sampling.reference import deformable_sampling_reference
from occdetr.structures import Memory

_reference_only = False


@contextlib.contextmanager
def reference_sampling() -> Iterator[None]:
    """Within this context all sampling takes the reference form, on every device.

    For export to formats that know PyTorch's own operators only. Holds for all threads.
    """
    global _reference_only
    before, _reference_only = _reference_only, True
    try:
        yield
    finally:
        _reference_only = before


def deformable_sampling(
    value: Float[Tensor, "batch token head channel"],
    spatial_shapes: list[tuple[int, int]],
    sampling_locations: Float[Tensor, "batch query 2 head level point"],
    attention_weights: Float[Tensor, "batch query head level point"],
) -> Float[Tensor, "batch query dim"]:
    """Weighted sum of bilinear samples of ``value`` at normalised ``sampling_locations`` (x, y).

    ``spatial_shapes``: (rows, columns) of each level. Outside of a map its value is zero. Heads are
    concatenated in the result. A kernel of the device does it if there is one, in float32 (float64
    for float64 locations) whatever the value's dtype, which the result has; else
    ``deformable_sampling_reference``.
    """
    if _reference_only or not has_kernel(value.device):
        return deformable_sampling_reference(
            value, spatial_shapes, sampling_locations, attention_weights
        )
    dtype = torch.promote_types(sampling_locations.dtype, torch.float32)
    shapes = [side for shape in spatial_shapes for side in shape]
    return sample(value, shapes, sampling_locations.to(dtype), attention_weights.to(dtype))


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
        value = self.value_proj(memory.tokens).unflatten(-1, (self.num_heads, -1))
        locations, weights = self.sampling_points(query, reference, memory)
        return self.output_proj(deformable_sampling(value, memory.shapes, locations, weights))

    def sampling_points(
        self,
        query: Float[Tensor, "batch query dim"],
        reference: Float[Tensor, "batch query coordinate"],
        memory: Memory,
    ) -> tuple[
        Float[Tensor, "batch query 2 head level point"],
        Float[Tensor, "batch query head level point"],
    ]:
        """Where each query samples, normalised (x, y), and the weights of the samples, which sum to
        1 in each head."""
        batch, queries, _ = query.shape
        heads, levels, points = self.num_heads, self.num_levels, self.num_points
        offsets = self._offsets(query)
        weights = self.attention_weights(query).view(batch, queries, heads, levels * points)
        weights = weights.softmax(-1).view(batch, queries, heads, levels, points)
        if reference.shape[-1] == 2:
            sizes = memory.cell_sizes().T[:, None, :, None]
            scale = sizes.expand(2, heads, levels, points).flatten(1)
        else:
            scale = reference[..., 2:, None] * (0.5 / points)
        locations = reference[..., :2, None] + offsets * scale
        return locations.view(batch, queries, 2, heads, levels, points), weights

    def _offsets(
        self, query: Float[Tensor, "batch query dim"]
    ) -> Float[Tensor, "batch query 2 sample"]:
        """All x, then all y, since arithmetic with the references is fastest on long rows.

        The layer's outputs, as checkpoints have them, alternate between x and y.
        """
        layer = self.sampling_offsets
        weight = layer.weight.unflatten(0, (-1, 2)).transpose(0, 1).flatten(0, 1)
        bias = layer.bias.view(-1, 2).T.flatten()
        return F.linear(query, weight, bias).unflatten(-1, (2, -1))
