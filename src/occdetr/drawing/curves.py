"""Curves over steps as an image."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from occdetr.drawing.boxes import BACKGROUND_COLOR, INK, MARGIN, Image, with_title

SIZE = 460, 900  # pixels, height and width, without title and legend
#: Okabe-Ito, for the colour-blind; further curves have them again, and thin lines.
COLORS = (
    *((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167)),
    *((86, 180, 233), (230, 159, 0), (90, 90, 90)),
)
_LEFT, _BOTTOM, _TOP, _RIGHT = 64, 40, 12, 24  # pixels around the axes
_FONT, _SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
_GRID = (225, 225, 225)
_ROW = 22  # pixels, of the legend


def draw_curves(
    curves: Mapping[str, Sequence[tuple[float, float]]], x_name: str, title: str
) -> Image:
    """Lines through points (x, y), with axes from zero, and a legend of their names.

    Points that are not finite are left out; a curve of one point is a dot.
    """
    finite = {
        name: [point for point in points if all(map(math.isfinite, point))]
        for name, points in curves.items()
    }
    points = [point for each in finite.values() for point in each]
    ticks = [
        _ticks(max((point[axis] for point in points), default=0.0), count)
        for axis, count in ((0, 8), (1, 6))
    ]
    low = min((point[1] for point in points), default=0.0)
    if low < 0:  # no score is, but a figure of the user's may be
        ticks[1] = [-tick for tick in reversed(_ticks(-low, 6)[1:])] + ticks[1]
    image = np.tile(BACKGROUND_COLOR, (*SIZE, 1))
    place = _draw_axes(image, ticks, x_name)
    for number, line in reversed(list(enumerate(finite.values()))):
        _draw_line(image, [place(*point) for point in line], number)
    return with_title(np.concatenate([image, _legend(list(finite))]), title)


def _ticks(most: float, count: int) -> list[float]:
    """About ``count`` round numbers from zero to at least ``most``."""
    rough = max(most, 1e-6) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * digit for digit in (1, 2, 5, 10) if power * digit >= rough * 0.999)
    return [number * step for number in range(math.ceil(max(most, 1e-6) / step - 1e-9) + 1)]


def _draw_axes(
    image: Image, ticks: Sequence[Sequence[float]], x_name: str
) -> Callable[[float, float], tuple[int, int]]:
    """Draw grid lines with their numbers; returns the function from (x, y) to pixels."""
    height, width = image.shape[0] - _BOTTOM - _TOP, image.shape[1] - _LEFT - _RIGHT
    (left, right), (low, high) = [(each[0], each[-1]) for each in ticks]

    def place(x: float, y: float) -> tuple[int, int]:
        column = _LEFT + width * (x - left) / (right - left)
        return round(column), round(_TOP + height * (high - y) / (high - low))

    for x in ticks[0]:
        column, bottom = place(x, low)
        cv2.line(image, (column, _TOP), (column, bottom), _GRID, 1)
        _write(image, f"{x:,.6g}", (column, bottom + 16), 0.5)
    for y in ticks[1]:
        edge, row = place(left, y)
        cv2.line(image, (edge, row), (edge + width, row), _GRID, 1)
        _write(image, f"{y:.6g}", (edge - 6, row + 5), 1.0)
    _write(image, x_name, (_LEFT + width, image.shape[0] - 6), 1.0)
    return place


def _draw_line(image: Image, pixels: Sequence[tuple[int, int]], number: int) -> None:
    color, thickness = _style(number)
    for start, end in itertools.pairwise(pixels):
        cv2.line(image, start, end, color, thickness, cv2.LINE_AA)
    for pixel in pixels:
        cv2.circle(image, pixel, thickness + 1, color, -1, cv2.LINE_AA)


def _style(number: int) -> tuple[tuple[int, int, int], int]:
    return COLORS[number % len(COLORS)], 2 if number < len(COLORS) else 1


def _legend(names: Sequence[str]) -> Image:
    """A row for each name; of one that is too long the end is left out."""
    legend = np.tile(BACKGROUND_COLOR, (_ROW * len(names) + MARGIN, SIZE[1], 1))
    for number, name in enumerate(names):
        color, thickness = _style(number)
        y = number * _ROW + _ROW // 2
        cv2.line(legend, (_LEFT, y), (_LEFT + 28, y), color, thickness, cv2.LINE_AA)
        while len(name) > 3 and _width(name) > SIZE[1] - _LEFT - _RIGHT - 36:
            name = f"{name.removesuffix('...')[:-1]}..."
        _write(legend, name, (_LEFT + 36, y + 5), 0.0)
    return legend


def _write(image: Image, text: str, place: tuple[int, int], align: float) -> None:
    """Text whose start (``align`` 0), middle (0.5) or end (1) is at ``place``, on its base line."""
    x, y = place
    start = (round(x - align * _width(text)), y)
    cv2.putText(image, text, start, _FONT, _SCALE, INK, 1, cv2.LINE_AA)


def _width(text: str) -> int:
    return cv2.getTextSize(text, _FONT, _SCALE, 1)[0][0]
