"""A plot of costs over the work."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from occdetr.drawing.plots import plot_panels


def draw_growth(curves: Mapping[str, Mapping[str, Any]], title: str) -> bytes:
    """A PNG with a panel for each curve, both axes logarithmic: every cost over its smallest.

    ``curves``: by name the ``work`` (a list), its ``unit``, and ``costs``, lists by name. A dotted
    line shows what linear growth would be.
    """

    def draw(panels: list[Axes]) -> None:
        for panel, (name, curve) in zip(panels, curves.items(), strict=True):
            work = curve["work"]
            for cost, values in curve["costs"].items():
                relative = [value / max(min(values), 1e-12) for value in values]
                panel.plot(work, relative, marker="o", markersize=3, label=cost)
            linear = [value / work[0] for value in work]
            panel.plot(work, linear, ":", color="gray", label="linear")
            panel.set(xscale="log", yscale="log", title=name, xlabel=curve["unit"])
            panel.set_xticks(work, [f"{value:,}" for value in work], rotation=30, ha="right")
            panel.set_xticks([], minor=True)
            panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            panel.yaxis.set_major_formatter("{x:g}")
            panel.yaxis.set_minor_formatter(NullFormatter())
        panels[0].set_ylabel("times the least")

    return plot_panels(draw, len(curves), (3.6, 4.2), title)
