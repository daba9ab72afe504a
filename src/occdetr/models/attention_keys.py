"""What the 3D queries of the occupancy decoder attend to: all queries, or the means of regions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from occdetr.models.occupancy_queries import Queries


def pooled_keys(
    queries: Queries,
    used: Bool[Tensor, "batch slot"],
    shape: Sequence[int],
    key_shape: Sequence[int],
) -> tuple[Float[Tensor, "batch key dim"], Bool[Tensor, "batch key"]]:
    """The mean feature of each object and of each region of the background, and which exist.

    ``queries.cells`` are cells of the grid ``shape``; the regions are those of the coarser grid
    ``key_shape``, both tile the same space. A region exists if there is a query in it, an object
    if its slot is ``used``. Attention to these keys costs queries times keys, not queries squared.
    """
    batch, slots = used.shape
    dense, sparse = queries.features.split(
        [queries.num_dense, queries.features.shape[1] - queries.num_dense], dim=1
    )
    objects = dense.reshape(batch, slots, -1, dense.shape[-1]).mean(2) if slots else dense
    number = key_shape[0] * key_shape[1] * key_shape[2]
    x, y, z = (
        queries.cells[..., axis] // (side // key_side)
        for axis, (side, key_side) in enumerate(zip(shape, key_shape, strict=True))
    )
    region = (x * key_shape[1] + y) * key_shape[2] + z
    sums, count = _sums_by_region(sparse.float(), region, number)  # bf16 counts to 256
    means = (sums / count.clamp(min=1)[..., None]).to(sparse.dtype)
    keys = torch.cat([objects, means], dim=1)
    return keys, torch.cat([used, count > 0], dim=1)


def _sums_by_region(
    features: Float[Tensor, "batch query dim"], region: Int[Tensor, "batch query"], number: int
) -> tuple[Float[Tensor, "batch region dim"], Float[Tensor, "batch region"]]:
    """The sum of the features in each of ``number`` regions, and how many they are.

    An exported graph holds a matrix product: TensorRT ignores that values scattered to the same
    place are to be added.
    """
    batch = len(features)
    if torch.compiler.is_exporting():
        member = region[..., None] == torch.arange(number, device=region.device)
        member = member.to(features.dtype)
        return member.transpose(1, 2) @ features, member.sum(1)
    flat = (region + number * torch.arange(batch, device=region.device)[:, None]).flatten()
    sums = features.new_zeros(batch * number, features.shape[-1])
    sums = sums.index_add(0, flat, features.flatten(0, 1))
    count = features.new_zeros(batch * number).index_add(0, flat, features.new_ones(flat.shape))
    return sums.unflatten(0, (batch, -1)), count.unflatten(0, (batch, -1))
