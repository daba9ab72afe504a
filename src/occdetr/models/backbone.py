"""ResNet (He et al., 2016) with torchvision's state-dict names, and its pretrained weights."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from http.client import HTTPException
from pathlib import Path
from typing import Protocol, Self, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from occdetr.errors import InputError
from occdetr.geometry.rois import check_strides

IMAGENET_FILES = {18: "resnet18-f37072fd.pth", 50: "resnet50-11ad3fa6.pth"}
STRIDES = (4, 8, 16, 32)  # of the four stages
WEIGHTS_URL = "https://download.pytorch.org/models/"


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


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions (ResNet-18)."""

    expansion = 1

    def __init__(self, in_channels: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.downsample = _downsample(in_channels, channels, stride)

    def forward(self, x: Tensor) -> Tensor:
        out = self.bn1(self.conv1(x)).relu()
        out = self.bn2(self.conv2(out))
        return (out + (x if self.downsample is None else self.downsample(x))).relu()


class Bottleneck(nn.Module):
    """1 x 1, 3 x 3 (with the stride, as torchvision), 1 x 1 convolutions (ResNet-50)."""

    expansion = 4

    def __init__(self, in_channels: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.conv3 = nn.Conv2d(channels, channels * 4, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(channels * 4)
        self.downsample = _downsample(in_channels, channels * 4, stride)

    def forward(self, x: Tensor) -> Tensor:
        out = self.bn1(self.conv1(x)).relu()
        out = self.bn2(self.conv2(out)).relu()
        out = self.bn3(self.conv3(out))
        return (out + (x if self.downsample is None else self.downsample(x))).relu()


def _downsample(in_channels: int, out_channels: int, stride: int) -> nn.Sequential | None:
    if stride == 1 and in_channels == out_channels:
        return None
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 1, stride, bias=False), nn.BatchNorm2d(out_channels)
    )


class ResNet(nn.Module):
    """ResNet trunk without the classifier; returns the maps at those of ``strides`` that it has.

    It has 4, 8, 16 and 32; ``strides`` may go on beyond (the encoder makes those levels).
    ``channels`` has the number of channels of each map, by stride.

    ``freeze_norm`` keeps every batch norm at its stored statistics and weights (Deformable DETR's
    "frozen batch norm"); without it they learn, as a trunk without pretrained weights needs.
    ``freeze_stem`` keeps the first convolution and the first stage as they are (Deformable DETR).
    ``weights``: "imagenet" (the official file, from torch.hub's cache or the network), a path to
    such a file, or None. Raises InputError for an unknown depth, strides that it does not have, or
    weights that cannot be loaded.
    """

    def __init__(
        self,
        depth: int = 50,
        weights: str | None = None,
        freeze_norm: bool = True,
        strides: Sequence[int] = (8, 16, 32),
        freeze_stem: bool = False,
    ) -> None:
        super().__init__()
        blocks = {18: (BasicBlock, (2, 2, 2, 2)), 50: (Bottleneck, (3, 4, 6, 3))}
        if depth not in blocks:
            raise InputError(f"model.backbone.depth={depth}: choose one of {sorted(blocks)}")
        check_strides("strides", strides)
        if strides[0] not in STRIDES:
            raise InputError(f"strides={list(strides)}: start at one of {list(STRIDES)}")
        block, counts = blocks[depth]
        self.freeze_norm = freeze_norm
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        channels = 64
        for index, count in enumerate(counts):
            width, stride = 64 * 2**index, 1 if index == 0 else 2
            layers = []
            for repeat in range(count):
                layers.append(block(channels, width, stride if repeat == 0 else 1))
                channels = width * block.expansion
            setattr(self, f"layer{index + 1}", nn.Sequential(*layers))
        self.returned = [f"layer{level + 1}" for level in range(4) if STRIDES[level] in strides]
        self.channels = {
            stride: 64 * 2**level * block.expansion
            for level, stride in enumerate(STRIDES)
            if stride in strides
        }
        self._initialise()
        if weights is not None:
            self.load_state_dict(official_weights(weights, depth), strict=False)
        if freeze_norm:
            for norm in batch_norms(self):
                norm.requires_grad_(False)
            self.freeze_statistics()  # now, since Lightning does not call train()
        if freeze_stem:
            for part in (self.conv1, self.bn1, self.get_submodule("layer1")):
                part.requires_grad_(False)

    def _initialise(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            # the last norm of a block starts small, so that activations do not grow with depth
            elif isinstance(module, BasicBlock):
                nn.init.constant_(module.bn2.weight, 0.2)
            elif isinstance(module, Bottleneck):
                nn.init.constant_(module.bn3.weight, 0.2)

    def train(self, mode: bool = True) -> Self:
        super().train(mode)
        if self.freeze_norm:
            self.freeze_statistics()
        return self

    def freeze_statistics(self) -> None:
        """Put every batch norm in evaluation mode: running statistics are used, not updated."""
        for norm in batch_norms(self):
            norm.eval()

    def forward(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> list[Float[Tensor, "batch _ _ _"]]:
        # channels last in memory: what every convolution of the CPU and of GPUs is fastest with
        images = images.contiguous(memory_format=torch.channels_last)
        x = self.maxpool(self.bn1(self.conv1(images)).relu())
        features = []
        for name in ("layer1", "layer2", "layer3", "layer4"):
            x = getattr(self, name)(x)
            if name in self.returned:
                features.append(x)
        return features


def _check_cached(name: str) -> None:
    """Raises ``ValueError`` if torch.hub's cache has another file of this name: torch checks the
    hash, whose start is in the name, of a download only."""
    cached = Path(torch.hub.get_dir(), "checkpoints", name)
    if cached.is_file():
        with cached.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        if not found.startswith(cached.stem.rpartition("-")[2]):
            raise ValueError("wrong hash")


def official_weights(weights: str, depth: int) -> dict[str, Tensor]:
    """torchvision's state dict of ResNet-``depth`` without the classifier.

    Raises InputError when there is no such file, no network, or the file is of another network.
    """
    if weights == "imagenet":
        try:
            _check_cached(IMAGENET_FILES[depth])
            state = torch.hub.load_state_dict_from_url(
                WEIGHTS_URL + IMAGENET_FILES[depth],
                map_location="cpu",
                check_hash=True,  # the file's name ends in the start of its SHA-256
                weights_only=True,
            )
        except (OSError, HTTPException) as error:
            raise InputError(
                f"model.backbone.weights=imagenet: could not download {IMAGENET_FILES[depth]} "
                f"({error}); give model.backbone.weights=<path to that file> or null"
            ) from error
        except Exception as error:  # a wrong hash, or a damaged file in the cache
            cached = Path(torch.hub.get_dir()) / "checkpoints" / IMAGENET_FILES[depth]
            raise InputError(
                f"model.backbone.weights=imagenet: {cached} is damaged ({type(error).__name__}); "
                "delete it and try again, or give model.backbone.weights=<path to that file>"
            ) from error
    else:
        if not Path(weights).is_file():
            raise InputError(
                f"model.backbone.weights={weights}: no such file; give the path of torchvision's "
                f"{IMAGENET_FILES[depth]}, or imagenet, or null"
            )
        try:
            state = torch.load(weights, map_location="cpu", weights_only=True)
        except Exception as error:
            raise InputError(
                f"model.backbone.weights={weights}: not a PyTorch state dict; give torchvision's "
                f"{IMAGENET_FILES[depth]}"
            ) from error
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(
            f"model.backbone.weights={weights}: not a PyTorch state dict; give torchvision's "
            f"{IMAGENET_FILES[depth]}"
        )
    state = {name: value for name, value in state.items() if not str(name).startswith("fc.")}
    with torch.device("meta"):
        expected = ResNet(depth).state_dict()
    wrong = [n for n, v in expected.items() if n in state and state[n].shape != v.shape]
    missing = [n for n in expected if n not in state and "num_batches_tracked" not in n]
    if wrong or missing:
        raise InputError(
            f"model.backbone.weights={weights}: does not hold a ResNet-{depth} "
            f"(first difference: {(wrong + missing)[0]}); "
            f"give torchvision's {IMAGENET_FILES[depth]}"
        )
    return state
