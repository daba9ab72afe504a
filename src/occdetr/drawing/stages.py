"""What the network computes on the way, as pictures: features, sampling points, cells, heat maps.

Arrays in, RGB images out, as everywhere in this package.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int, Integer, UInt8

from occdetr.drawing.boxes import Image
from occdetr.drawing.grids import FIRST_OBJECT
from occdetr.geometry.camera import denormalize_pixels
from occdetr.geometry.voxels import GRID_SHAPE

_SPREAD = 2.5  # standard deviations of a principal component from black to white, to each side
_SHADES = 32  # of probability in painted cells
_DARKER = 0.82  # every other cell, so that neighbours can be distinguished


def feature_picture(
    features: Float[np.ndarray, "rows columns channel"], size: tuple[int, int]
) -> Image:
    """A map of features as colours: its first three principal components are red, green and blue.

    Places of similar features have similar colours; the colours themselves mean nothing. ``size``
    is (height, width) in pixels.
    """
    flat = features.reshape(-1, features.shape[-1]).astype(np.float64)
    flat = flat - flat.mean(axis=0)
    _, axes = np.linalg.eigh(flat.T @ flat)  # ascending
    parts = flat @ axes[:, :-4:-1]
    shades = 0.5 + parts / (2 * _SPREAD * parts.std(axis=0).clip(1e-9))
    colors = np.rint(255 * shades.clip(0, 1)).astype(np.uint8)
    return _enlarged(colors.reshape(*features.shape[:2], -1), size)


def heat_picture(
    values: Float[np.ndarray, "rows columns"], size: tuple[int, int], most: float = 1.0
) -> Image:
    """A map of values as colours, from dark blue (0) to yellow (``most``); ``size`` in pixels."""
    return _enlarged(_heat(values / most), size)


def draw_samples(
    image: Image, points: Float[np.ndarray, "point 2"], weights: Float[np.ndarray, " point"]
) -> Image:
    """A copy of an image with sampling points (x, y; normalised) as discs.

    The area of a disc, and its colour from dark blue to yellow, are those of its weight, relative
    to the largest one.
    """
    image = np.ascontiguousarray(image).copy()
    shares = weights / weights.max(initial=1e-9)
    places = np.rint(16 * denormalize_pixels(points, image.shape[:2])).astype(int)
    radii = np.rint(16 * image.shape[0] / 40 * np.sqrt(shares)).astype(int)
    colors = _heat(shares[None])[0].tolist()
    for index in np.argsort(-shares, kind="stable").tolist():  # small ones on top
        place = places[index].tolist()
        cv2.circle(image, place, int(radii[index]) + 16, (0, 0, 0), -1, cv2.LINE_AA, shift=4)
        cv2.circle(image, place, int(radii[index]), colors[index], -1, cv2.LINE_AA, shift=4)
    return image


def paint_cells(
    coordinates: Int[np.ndarray, "cell 3"], cell: int, values: Float[np.ndarray, " cell"]
) -> tuple[Integer[np.ndarray, "x y z"], UInt8[np.ndarray, "color 3"]]:
    """A grid and its palette for ``render_grid``: cells of ``cell`` x ``cell`` x ``cell`` voxels.

    Their colour is that of their value, from dark blue (0) to yellow (1); neighbours differ in
    brightness.
    """
    shade = np.rint(values.clip(0, 1) * (_SHADES - 1)).astype(np.int32)
    coarse = np.zeros([side // cell for side in GRID_SHAPE], dtype=np.int32)
    odd = coordinates.sum(axis=1) % 2
    coarse[tuple(coordinates.T)] = FIRST_OBJECT + 2 * shade + odd
    grid = coarse
    for axis in range(3):
        grid = grid.repeat(cell, axis=axis)
    colors = _heat(np.linspace(0, 1, _SHADES)[None])[0]
    palette = np.zeros((FIRST_OBJECT + 2 * _SHADES, 3), dtype=np.uint8)
    palette[FIRST_OBJECT::2] = colors
    palette[FIRST_OBJECT + 1 :: 2] = np.rint(_DARKER * colors)
    return grid, palette


def _heat(values: Float[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns 3"]:
    levels = np.rint(255 * values.clip(0, 1)).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1])


def _enlarged(image: Image, size: tuple[int, int]) -> Image:
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_NEAREST)
