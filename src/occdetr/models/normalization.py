"""Images as the backbone takes them, made on the network's device from bytes, and back."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from occdetr.structures import Images

#: Mean and standard deviation of RGB values from 0 to 1 (ImageNet).
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def normalize_images(images: Images) -> Float[Tensor, "batch 3 height width"]:
    """(value / 255 - mean) / deviation of each channel's bytes; floats are normalised already."""
    if images.dtype != torch.uint8:
        return images
    values = images.float()  # at once: TensorRT does nothing else with bytes
    channels = [
        values[:, index] * (1 / (255 * std)) - mean / std
        for index, (mean, std) in enumerate(zip(IMAGENET_MEAN, IMAGENET_STD, strict=True))
    ]
    return torch.stack(channels, dim=1)


def denormalize_images(images: Images) -> UInt8[Tensor, "batch 3 height width"]:
    """The bytes that ``normalize_images`` was given."""
    if images.dtype == torch.uint8:
        return images
    mean, std = images.new_tensor(IMAGENET_MEAN), images.new_tensor(IMAGENET_STD)
    pixels = (images * std[:, None, None] + mean[:, None, None]).clamp(0, 1) * 255
    return pixels.round().to(torch.uint8)
