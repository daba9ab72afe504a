"""The numbers that losses are divided by, for one process and for several ranks."""

from __future__ import annotations

import torch
from torch import Tensor
from torch import distributed as dist


def normalizer(count: int | Tensor, device: torch.device) -> int | Tensor:
    """What to divide the sum of ``count`` terms (at least 1) by to get a loss; elementwise.

    In one process it is ``count`` itself. DDP averages the gradients of its ranks, so there it is
    the count of all ranks over their number: the averaged gradient is then that of one process with
    the frames of all ranks. Every rank must call it equally often; without gradients (validation),
    where ranks may have different numbers of batches, they do not communicate.

    The batches of ``accumulate_grad_batches`` are divided each by its own count, as is usual, since
    the later ones are not known yet: the accumulated gradient is the mean of their gradients.
    """
    if not (dist.is_available() and dist.is_initialized() and torch.is_grad_enabled()):
        return max(count, 1) if isinstance(count, int) else count.clamp(min=1)
    total = torch.zeros_like(count) if isinstance(count, Tensor) else torch.zeros((), device=device)
    total = (total + count).float()
    dist.all_reduce(total)
    return total.clamp(min=1) / dist.get_world_size()


def mean_over_ranks(values: Tensor) -> Tensor:
    """Losses of a batch as one process would have them with the frames of all ranks."""
    if not (dist.is_available() and dist.is_initialized() and torch.is_grad_enabled()):
        return values
    total = values.clone()
    dist.all_reduce(total)
    return total / dist.get_world_size()
