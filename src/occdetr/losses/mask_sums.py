"""The sums over voxels of which the mask head's terms are made.

A voxel has at most one true class. So only the sums over all classes have classes x voxels
elements; what is added at the true classes has one for each voxel. The first are taken in one pass
by blocks of voxels that fit the processor's cache, and their gradients in a second one.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from occdetr.losses.detection import focal_loss

EMPTY, UNKNOWN = -1, -2  # voxels without a true class
BLOCK = 8192  # voxels: 0.6 MiB for 19 classes
MAX_EXPONENT = 60.0  # beyond it log(1 + exp(x)) is x
LOG2_E = math.log2(math.e)


class MaskSums(NamedTuple):
    """Sums over the known voxels of each frame; those by class are of what the name says.

    ``focal``: focal loss of all classes. ``area``: probability (sigmoid), ``overlap``: the same of
    the true voxels alone. ``entropy``: cross-entropy of the classes' softmax in occupied voxels.
    ``written``: occupancy times softmax, which fusion compares; ``hits``: the same of the true
    voxels alone. ``count``: true voxels.
    """

    focal: Float[Tensor, " batch"]
    area: Float[Tensor, "batch class"]
    overlap: Float[Tensor, "batch class"]
    entropy: Float[Tensor, " batch"]
    written: Float[Tensor, "batch class"]
    hits: Float[Tensor, "batch class"]
    count: Float[Tensor, "batch class"]


def mask_sums(
    logits: Float[Tensor, "batch class voxel"],
    occupancy: Float[Tensor, "batch voxel"],
    index: Int[Tensor, "batch voxel"],
) -> MaskSums:
    """``index`` is the true class of each voxel, or ``EMPTY`` or ``UNKNOWN``; ``occupancy`` are
    logits too."""
    dtype = torch.promote_types(logits.dtype, torch.float32)
    known, occupied = (index != UNKNOWN).to(dtype), (index >= 0).to(dtype)
    weight = known * occupancy.to(dtype).sigmoid()
    own = index.clamp(min=0)
    blockwise = logits.device.type == "cpu" and not torch.compiler.is_compiling()
    over_classes = _BlockwiseSums.apply if blockwise else sums_over_classes
    focal, area, written, log_total, at_truth = over_classes(logits, known, weight, own)
    correction = focal_loss(at_truth, 1.0) - focal_loss(at_truth, 0.0)
    share = (at_truth - log_total).exp()

    def by_class(values: Tensor) -> Tensor:
        sums = torch.zeros(area.shape, dtype=torch.float64, device=area.device)
        return sums.scatter_add(1, own, (values * occupied).double()).to(dtype)

    return MaskSums(
        focal=focal + (correction * occupied).sum(1),
        area=area,
        overlap=by_class(at_truth.sigmoid()),
        entropy=((log_total - at_truth) * occupied).sum(1),
        written=written,
        hits=by_class(share * weight),
        count=by_class(occupied),
    )


def sums_over_classes(logits: Tensor, known: Tensor, weight: Tensor, own: Tensor) -> tuple:
    """The sums with classes x voxels elements, as plain formulas that a compiler can join.

    ``known``, ``weight`` and ``own`` are [batch, voxel]: 1 or 0, the factor of the softmax, and the
    true class, or any. Returns the focal loss as if all classes were false [batch]; the known
    voxels' probability and the weighted softmax [batch, class]; by voxel the logarithm of the
    softmax's denominator, and the logit of the true class.
    """
    logits = logits.to(weight.dtype)
    focal = (focal_loss(logits, 0.0) * known[:, None]).sum((1, 2))
    area = (logits.sigmoid() * known[:, None]).sum(2)
    written = (logits.softmax(1) * weight[:, None]).sum(2)
    return focal, area, written, logits.logsumexp(1), logits.gather(1, own[:, None])[:, 0]


class _BlockwiseSums(torch.autograd.Function):
    """``sums_over_classes``; the second pass computes again what the first had in the cache."""

    @staticmethod
    def forward(
        ctx: Any, logits: Tensor, known: Tensor, weight: Tensor, own: Tensor
    ) -> tuple[Tensor, ...]:
        focal = torch.zeros(len(logits), dtype=torch.float64)
        area, written = torch.zeros(2, *logits.shape[:2], dtype=torch.float64)
        log_total = torch.empty_like(weight)
        for frame, voxels in _blocks(logits):
            x, mask = logits[frame, :, voxels].to(weight.dtype), known[frame, voxels]
            probability, _, softplus = _sigmoid_softplus(x)
            area[frame] += probability @ mask
            focal[frame] += (probability.square_().mul_(softplus) @ mask).sum()
            top = x.amax(0)
            shares = _exp_(torch.sub(x, top))
            total = shares.sum(0)
            log_total[frame, voxels] = total.log().add_(top)
            written[frame] += shares @ (weight[frame, voxels] / total)
        at_truth = logits.gather(1, own[:, None])[:, 0].to(weight.dtype)
        ctx.save_for_backward(logits, known, weight, own, log_total)
        return *(x.to(weight.dtype) for x in (0.75 * focal, area, written)), log_total, at_truth

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, focal: Tensor, area: Tensor, written: Tensor, log_total: Tensor, at_truth: Tensor
    ) -> tuple[Tensor, None, Tensor, None]:
        logits, known, weight, own, log_totals = ctx.saved_tensors
        gradient, of_weight = torch.empty_like(logits), torch.empty_like(weight)
        for frame, voxels in _blocks(logits):
            x, share = logits[frame, :, voxels].to(weight.dtype), weight[frame, voxels]
            p, q, softplus = _sigmoid_softplus(x)
            # focal: (0.75 p^2 softplus)' = 0.75 p^2 (2 q softplus + p); sigmoid: p q
            slope = softplus.mul_(q).mul_(2).add_(p).mul_(p).mul_(0.75 * focal[frame])
            slope.addcmul_(q, area[frame, :, None]).mul_(p).mul_(known[frame, voxels])
            # softmax m: m (weight (a - sum of m a) + that of the logarithm), a from ``written``
            softmax = _exp_(torch.sub(x, log_totals[frame, voxels], out=p))
            mean = written[frame] @ softmax
            factor = torch.mul(written[frame, :, None], share, out=q)
            factor.add_(log_total[frame, voxels] - share * mean)
            gradient[frame, :, voxels] = slope.addcmul_(softmax, factor)
            of_weight[frame, voxels] = mean
        gradient.scatter_add_(1, own[:, None], at_truth[:, None].to(logits.dtype))
        return gradient, None, of_weight, None


def _blocks(logits: Tensor) -> list[tuple[int, slice]]:
    starts = range(0, logits.shape[2], BLOCK)
    return [(frame, slice(at, at + BLOCK)) for frame in range(len(logits)) for at in starts]


def _sigmoid_softplus(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The sigmoid, 1 - sigmoid, and log(1 + exp(x)), from one exponential."""
    exponential = _exp_(x.clamp(max=MAX_EXPONENT))
    softplus = torch.maximum(torch.log1p(exponential), x)
    complement = (exponential + 1).reciprocal_()
    return exponential.mul_(complement), complement, softplus


def _exp_(x: Tensor) -> Tensor:
    """exp(x), in place. PyTorch computes powers of 2 three times as fast as those of e."""
    return x.mul_(LOG2_E).exp2_()
