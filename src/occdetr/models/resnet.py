"""ResNet (He et al., 2016) with torchvision's state-dict names, and its pretrained weights."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.errors import InputError
from occdetr.models.backbone import Trunk, convolve
from occdetr.models.pretrained import OfficialFile, check_state, read_weights

IMAGENET = {
    18: OfficialFile("resnet18-f37072fd.pth", "a ResNet-18"),
    50: OfficialFile("resnet50-11ad3fa6.pth", "a ResNet-50"),
}
STRIDES = (4, 8, 16, 32)  # of the four stages


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
        out = convolve(x, self.conv1, self.bn1).relu()
        out = convolve(out, self.conv2, self.bn2)
        return (out + (x if self.downsample is None else convolve(x, *self.downsample))).relu()


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
        out = convolve(x, self.conv1, self.bn1).relu()
        out = convolve(out, self.conv2, self.bn2).relu()
        out = convolve(out, self.conv3, self.bn3)
        return (out + (x if self.downsample is None else convolve(x, *self.downsample))).relu()


def _downsample(in_channels: int, out_channels: int, stride: int) -> nn.Sequential | None:
    if stride == 1 and in_channels == out_channels:
        return None
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 1, stride, bias=False), nn.BatchNorm2d(out_channels)
    )


class ResNet(Trunk):
    """ResNet trunk without the classifier; returns the maps at those of ``strides`` that it has.

    ``strides`` may go on beyond 32 (the encoder makes those levels). ``freeze_stem`` keeps the
    first convolution and the first stage as they are (Deformable DETR). ``weights``: "imagenet"
    (torchvision's file, from torch.hub's cache or the network), a path to such a file, or None.

    Raises InputError for an unknown depth, strides that it does not have, or weights that cannot be
    loaded.
    """

    def __init__(
        self,
        depth: int = 50,
        weights: str | None = None,
        freeze_norm: bool = True,
        strides: Sequence[int] = (8, 16, 32),
        freeze_stem: bool = False,
    ) -> None:
        blocks = {18: (BasicBlock, (2, 2, 2, 2)), 50: (Bottleneck, (3, 4, 6, 3))}
        if depth not in blocks:
            raise InputError(f"model.backbone.depth={depth}: choose one of {sorted(blocks)}")
        block, counts = blocks[depth]
        widths = {stride: 64 * 2**i * block.expansion for i, stride in enumerate(STRIDES)}
        super().__init__(widths, strides, freeze_norm)
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
        self.returned = [
            f"layer{level + 1}" for level in range(4) if STRIDES[level] in self.channels
        ]
        self._initialise()
        if weights is not None:
            self.load_state_dict(imagenet_state(weights, depth), strict=False)
        self.freeze((self.conv1, self.bn1, self.get_submodule("layer1")) if freeze_stem else ())

    def _initialise(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            # the last norm of a block starts small, so that activations do not grow with depth
            elif isinstance(module, BasicBlock):
                nn.init.constant_(module.bn2.weight, 0.2)
            elif isinstance(module, Bottleneck):
                nn.init.constant_(module.bn3.weight, 0.2)

    def forward(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> list[Float[Tensor, "batch _ _ _"]]:
        # channels last in memory: what every convolution of the CPU and of GPUs is fastest with
        images = images.contiguous(memory_format=torch.channels_last)
        x = self.maxpool(convolve(images, self.conv1, self.bn1).relu())
        features = []
        for name in ("layer1", "layer2", "layer3", "layer4"):
            x = getattr(self, name)(x)
            if name in self.returned:
                features.append(x)
        return features


def imagenet_state(weights: str, depth: int) -> dict[str, Tensor]:
    """torchvision's state dict of ResNet-``depth`` without the classifier.

    Raises InputError when there is no such file, no network, or the file is of another network.
    """
    state = read_weights(weights, IMAGENET[depth])
    state = {name: value for name, value in state.items() if not str(name).startswith("fc.")}
    with torch.device("meta"):
        expected = ResNet(depth).state_dict()
    check_state(state, expected, weights, IMAGENET[depth])
    return state
