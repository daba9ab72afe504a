"""The confusion matrix as an image."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Int

from occdetr.classes import CLASS_COLORS, CLASS_NAMES
from occdetr.drawing.boxes import BACKGROUND_COLOR, INK, Image, with_title

CELL = 44  # pixels, along each side
_NAMES, _TOTALS = 132, 96  # pixels of the names' and the totals' columns
_PATCH = 12
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MIN_SHARE = 0.0005  # smaller shares are not written


def draw_confusion(confusion: Int[np.ndarray, "class class"]) -> Image:
    """A confusion matrix of voxels (rows prediction, columns truth), drawn with the truth in rows.

    Each row shows the predicted classes of the voxels of a true class in percent; their number is
    written to the right. A class without voxels has a white row.
    """
    counts = confusion.T
    totals, side = counts.sum(axis=1), CELL * len(counts)
    image = np.tile(BACKGROUND_COLOR, (_NAMES + side, _NAMES + side + _TOTALS, 1))
    image[_NAMES:, :_NAMES] = _names(align_right=True)
    image[:_NAMES, _NAMES : _NAMES + side] = np.rot90(_names(align_right=False))
    for row, total in enumerate(totals.tolist()):
        y = _NAMES + row * CELL
        for column, count in enumerate(counts[row].tolist() if total else ()):
            _draw_cell(image, (_NAMES + column * CELL, y), count / total)
        number = f"{total:,}" if total < 1e6 else f"{total / 1e6:,.1f} M"
        _write(image, number, (_NAMES + side + 8, y + CELL // 2 + 5))
    _write(image, "truth", (8, _NAMES - 10))
    _write(image, "predicted:", (8, 24))
    _write(image, "voxels", (_NAMES + side + 8, _NAMES - 10))
    return with_title(image, "What the voxels of each true class (row) were predicted as, in %")


def _draw_cell(image: Image, corner: tuple[int, int], share: float) -> None:
    """Fill a cell and, unless it is about 0, write its percentage."""
    level = np.array([[round(255 * share)]], dtype=np.uint8)
    color = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[0, 0, ::-1]
    x, y = corner
    image[y : y + CELL - 1, x : x + CELL - 1] = color
    if share < _MIN_SHARE:
        return
    text = f"{100 * share:.1f}" if share < 0.0995 else f"{100 * share:.0f}"
    (width, height), _ = cv2.getTextSize(text, _FONT, 0.42, 1)
    ink = INK if share > 0.5 else (255, 255, 255)
    place = (x + (CELL - width) // 2, y + (CELL + height) // 2)
    cv2.putText(image, text, place, _FONT, 0.42, ink, 1, cv2.LINE_AA)


def _names(align_right: bool) -> Image:
    """The names of all classes, one below the other, each with its colour beside it."""
    image = np.tile(BACKGROUND_COLOR, (CELL * len(CLASS_NAMES), _NAMES, 1))
    for index, name in enumerate(CLASS_NAMES):
        middle = index * CELL + CELL // 2
        (width, _), _ = cv2.getTextSize(name, _FONT, 0.42, 1)
        x = _NAMES - 6 - _PATCH if align_right else 6
        corners = (x, middle - _PATCH // 2), (x + _PATCH, middle + _PATCH // 2)
        cv2.rectangle(image, *corners, CLASS_COLORS[index].tolist(), -1)
        _write(image, name, (x - 6 - width if align_right else x + _PATCH + 6, middle + 5))
    return image


def _write(image: Image, text: str, place: tuple[int, int]) -> None:
    cv2.putText(image, text, place, _FONT, 0.42, INK, 1, cv2.LINE_AA)
