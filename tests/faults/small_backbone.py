"""A backbone of 5,000 weights, so that a run takes seconds and a checkpoint a tenth of a MB."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

WIDTHS = (8, 8, 16, 16)  # of the maps at strides 4, 8, 16, 32


class SmallBackbone(nn.Module):
    """A stem and three convolutions with batch norms, each with a stride of 2."""

    def __init__(self, strides: Sequence[int], weights: str | None = None) -> None:
        super().__init__()
        inputs = (8, *WIDTHS)
        self.stem = nn.Conv2d(3, inputs[0], 3, 2, 1, bias=False)
        self.stages = nn.ModuleList(
            nn.Sequential(nn.Conv2d(a, b, 3, 2, 1, bias=False), nn.BatchNorm2d(b), nn.ReLU())
            for a, b in zip(inputs, WIDTHS, strict=False)
        )
        self.returned = [4 * 2**level in strides for level in range(len(WIDTHS))]

    def freeze_statistics(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()

    def forward(self, images: Tensor) -> list[Tensor]:
        x, maps = self.stem(images), []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        return [each for each, returned in zip(maps, self.returned, strict=True) if returned]
