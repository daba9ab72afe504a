"""Curves over steps: where their points are, and what is left out."""

import math

import cv2
import numpy as np
import pytest

from occdetr.drawing.curves import Curve, draw_curves
from occdetr.drawing.plots import COLORS


def drawn(panels, title="title"):
    """The picture of curves over steps, RGB."""
    png = np.frombuffer(draw_curves(panels, "steps", title), np.uint8)
    return cv2.cvtColor(cv2.imdecode(png, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def pixels(image, number):
    """Rows and columns in about the colour of a curve, above the legend."""
    color = [int(COLORS[number][i : i + 2], 16) for i in (1, 3, 5)]
    other = np.abs(image[: image.shape[0] * 3 // 4].astype(int) - color).max(axis=-1)
    return np.nonzero(other < 40)  # lines have soft edges


def test_a_higher_curve_is_drawn_higher_and_a_later_point_to_the_right():
    curves = {"low": Curve([(0, 4), (100, 5)]), "high": Curve([(0, 8), (50, 9)])}
    image = drawn({"mIoU, %": curves})
    (low_rows, low_columns), (high_rows, high_columns) = pixels(image, 0), pixels(image, 1)
    assert high_rows.max() < low_rows.min()
    assert high_columns.max() < low_columns.max()
    assert abs(high_columns.min() - low_columns.min()) <= 2


def test_single_runs_are_drawn_beside_their_mean():
    mean, run = [(0, 1.0), (9, 5.0)], [(0, 3.0), (9, 3.0)]
    alone, whole = (drawn({"x": {"mean": Curve(mean, each)}}) for each in ([], [run]))
    rows = np.nonzero((alone != whole).any(axis=(1, 2)))[0]
    assert len(rows) == rows.max() - rows.min() + 1 < 6  # a flat line
    mean_rows = pixels(alone, 0)[0]
    assert mean_rows.min() < rows.min() < rows.max() < mean_rows.max()


def test_each_panel_has_the_same_colours():
    one, other = {"a": Curve([(1, 1), (2, 2)])}, {"a": Curve([(1, 2), (2, 1)])}
    image = drawn({"left": one, "right": other})
    left, right = np.split(image, [image.shape[1] // 2], axis=1)
    assert all(len(pixels(half, 0)[0]) for half in (left, right))
    assert not any(len(pixels(half, 1)[0]) for half in (left, right))


@pytest.mark.parametrize(
    "points", [[], [(5, math.nan)], [(5, 0.0)], [(0, -2.0), (9, 3.0)], [(1, 1e-9)], [(10**7, 3e5)]]
)
def test_any_figures_and_names_are_drawn(points):
    name = "a run with a $name that is longer than the picture is wide" * 4
    image = drawn({"x": {name: Curve(points)}}, title="50 $ a_b")
    assert (len(pixels(image, 0)[0]) > 0) == any(map(math.isfinite, [y for _, y in points]))


def test_the_file_depends_on_the_figures_alone():
    def bytes_of(y):
        return draw_curves({"x": {"a": Curve([(0, 1), (1, y)])}}, "steps", "title")

    assert bytes_of(2) == bytes_of(2) != bytes_of(3)
