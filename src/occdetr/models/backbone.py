"""What all backbones have in common: their protocol, frozen batch norms, the maps asked for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol, Self, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from occdetr.errors import InputError
from occdetr.geometry.rois import check_strides


@runtime_checkable
class Backbone(Protocol):
    """What the network needs of a backbone, a ``torch.nn.Module`` (docs/extending.md)."""

    def __call__(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> list[Float[Tensor, "batch _ _ _"]]:
        """Feature maps, finest first; that of stride s has ceil(height / s) rows."""
        ...

    def freeze_statistics(self) -> None:
        """Put every batch norm in evaluation mode."""
        ...


class Trunk(nn.Module):
    """A backbone of convolutions and batch norms, whose last maps have the strides 4, 8, 16, 32.

    ``channels``: the number of channels of each map that it returns, by stride. ``freeze_norm``
    keeps every batch norm at its stored statistics and weights (Deformable DETR's "frozen batch
    norm"); without it they learn, as a trunk without pretrained weights needs.
    """

    def __init__(
        self, channels: Mapping[int, int], strides: Sequence[int], freeze_norm: bool
    ) -> None:
        super().__init__()
        check_strides("strides", strides)
        if strides[0] not in channels:
            raise InputError(f"strides={list(strides)}: start at one of {list(channels)}")
        self.channels = {stride: channels[stride] for stride in channels if stride in strides}
        self.freeze_norm = freeze_norm

    def freeze(self, parts: Iterable[nn.Module]) -> None:
        """Freeze ``parts`` for good, and the batch norms if they are to be: once all is loaded."""
        if self.freeze_norm:
            for norm in batch_norms(self):
                norm.requires_grad_(False)
            self.freeze_statistics()  # now, since Lightning does not call train()
        for part in parts:
            part.requires_grad_(False)

    def train(self, mode: bool = True) -> Self:
        super().train(mode)
        if self.freeze_norm:
            self.freeze_statistics()
        return self

    def freeze_statistics(self) -> None:
        """Put every batch norm in evaluation mode: running statistics are used, not updated."""
        for norm in batch_norms(self):
            norm.eval()


def convolve(
    x: Float[Tensor, "batch _ _ _"], convolution: nn.Module, norm: nn.Module
) -> Float[Tensor, "batch _ _ _"]:
    """``norm(convolution(x))``, where a batch norm in evaluation mode takes no pass of its own.

    It is linear then: its factors go to the kernel, the rest is the bias.
    """
    if norm.training or not isinstance(norm, _BatchNorm) or norm.running_var is None:
        return norm(convolution(x))
    assert norm.running_mean is not None
    assert isinstance(convolution, nn.Conv2d)
    exact = torch.promote_types(norm.weight.dtype, torch.float32)
    scale = norm.weight * (norm.running_var.to(exact) + norm.eps).rsqrt()
    weight = convolution.weight * scale[:, None, None, None]
    bias = norm.bias - norm.running_mean * scale
    return F.conv2d(
        x,
        weight.to(convolution.weight.dtype),
        bias.to(norm.bias.dtype),
        convolution.stride,
        convolution.padding,
        convolution.dilation,
        convolution.groups,
    )


def batch_norms(module: nn.Module) -> list[_BatchNorm]:
    """Its batch norms of any dimension, those synchronised between ranks included."""
    return [part for part in module.modules() if isinstance(part, _BatchNorm)]


def has_statistics(module: nn.Module) -> bool:
    """Whether all its batch norms have gathered statistics, or loaded them: in no one are all
    means 0 and all variances 1, as they are made."""
    return not any(
        norm.running_mean is not None
        and norm.running_var is not None
        and not norm.running_mean.any()
        and (norm.running_var == 1).all()
        for norm in batch_norms(module)
    )
