"""Preset regions of interest, one per memory token (paper, Section III-B)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from occdetr.errors import COUNT, InputError, Range, check_each, check_range
from occdetr.geometry.camera import check_image_size


def level_shapes(image_size: tuple[int, int], strides: Sequence[int]) -> list[tuple[int, int]]:
    """(height, width) of each feature level; a stride-2 convolution rounds up."""
    height, width = image_size
    return [(-(-height // stride), -(-width // stride)) for stride in strides]


SCALE = Range(0, 100, open_least=True)


@dataclass(frozen=True)
class RoiLayout:
    """What determines the preset ROIs: see ``preset_rois``. ``image_size`` is (height, width).

    Raises ``InputError`` on values out of range.
    """

    image_size: tuple[int, int]
    strides: Sequence[int]
    scale: float

    def __post_init__(self) -> None:
        check_image_size("image_size", self.image_size)
        check_strides("strides", self.strides)
        check_range("roi_scale", self.scale, SCALE)

    def boxes(self) -> Float[NDArray, "token 4"]:
        """The preset ROIs, normalised cxcywh."""
        size = (int(self.image_size[0]), int(self.image_size[1]))
        return preset_rois(size, self.strides, self.scale)


def check_strides(setting: str, strides: Sequence[int]) -> None:
    """Raises ``InputError`` unless each stride is twice the one before, as feature levels are."""
    check_each(setting, strides, COUNT)
    doubled = all(b == 2 * a for a, b in itertools.pairwise(strides))
    if not strides or not doubled:
        raise InputError(
            f"{setting}={list(strides)}: each must be twice the one before, as in [8, 16, 32, 64]"
        )


def preset_rois(
    image_size: tuple[int, int], strides: Sequence[int], scale: float
) -> Float[NDArray, "token 4"]:
    """One square box per memory token, centred on it, with a side of ``scale * stride`` pixels.

    Normalised cxcywh, in the order of the flattened memory (levels, rows, columns).
    """
    height, width = image_size
    rois = []
    for stride, (rows, columns) in zip(strides, level_shapes(image_size, strides), strict=True):
        y, x = np.mgrid[0:rows, 0:columns]
        center = np.stack([(x + 0.5) / columns, (y + 0.5) / rows], axis=-1).reshape(-1, 2)
        size = np.array([scale * stride / width, scale * stride / height])
        rois.append(np.concatenate([center, np.broadcast_to(size, center.shape)], axis=1))
    return np.concatenate(rois).astype(np.float32)
