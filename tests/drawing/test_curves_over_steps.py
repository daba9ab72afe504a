"""Curves over steps: where their points are, and what is left out."""

import math

import numpy as np
import pytest

from occdetr.drawing.curves import COLORS, SIZE, draw_curves


def pixels(image, color):
    rows, columns = np.nonzero((image == color).all(axis=-1))
    return rows, columns


def test_a_higher_curve_is_drawn_higher_and_a_later_point_to_the_right():
    image = draw_curves(
        {"low": [(0, 1), (100, 2)], "high": [(0, 8), (50, 9)]}, "steps", "mIoU, in %"
    )
    assert image.shape[1] == SIZE[1]
    image = image[: SIZE[0]]  # without the legend
    (low_rows, low_columns), (high_rows, high_columns) = (
        pixels(image, color) for color in COLORS[:2]
    )
    assert high_rows.max() < low_rows.min()
    assert high_columns.max() < low_columns.max()
    assert high_columns.min() == low_columns.min()


@pytest.mark.parametrize(
    "points", [[], [(5, math.nan)], [(5, 0.0)], [(0, -2.0), (9, 3.0)], [(1, 1e-9)], [(10**7, 3e5)]]
)
def test_any_figures_are_drawn(points):
    image = draw_curves({"a run with a name that is longer than the picture is wide" * 4: points},
                        "steps", "x")  # fmt: skip
    drawn = len(pixels(image[: SIZE[0]], COLORS[0])[0])
    assert (drawn > 0) == any(map(math.isfinite, [y for _, y in points]))
