"""Curves over steps."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes

from occdetr.drawing.plots import plot_panels

#: (x, y), where what is not finite is left out.
Points = Sequence[tuple[float, float]]
LONGEST = 110  # characters of a name


@dataclass(frozen=True)
class Curve:
    """A line, and thin ones of the same colour: the single runs of which it is the mean."""

    points: Points
    runs: Sequence[Points] = ()


def draw_curves(panels: Mapping[str, Mapping[str, Curve]], x_name: str, title: str) -> bytes:
    """A PNG with a panel for each name of a y axis, with curves by name; axes begin at zero."""

    def draw(axes: list[Axes]) -> None:
        for axis, (y_name, curves) in zip(axes, panels.items(), strict=True):
            for name, curve in curves.items():
                _draw_curve(axis, name, curve)
            low = min(0.0, *axis.get_ylim()) if axis.lines else 0.0  # no score is below
            axis.set(xlabel=x_name, ylabel=y_name, xlim=(0, None), ylim=(low, None))

    width = 8.0 if len(panels) == 1 else 4.5
    return plot_panels(draw, len(panels), (width, width / 2 + 1.5), title)


def _draw_curve(axis: Axes, name: str, curve: Curve) -> None:
    shown = textwrap.shorten(name, LONGEST, placeholder="...")
    x, y = zip(*curve.points, strict=True) if curve.points else ((), ())
    (line,) = axis.plot(x, y, linewidth=2, marker="o", markersize=3, label=shown)
    style = {"color": line.get_color(), "linestyle": line.get_linestyle()}
    for run in curve.runs:
        axis.plot(*zip(*run, strict=True), **style, linewidth=0.8, alpha=0.5)
