"""A plot of costs over the work, as a PNG file whose bytes depend only on the figures."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

COLORS = ("#0072b2", "#d55e00", "#009e73")  # Okabe-Ito, for the colour-blind


def draw_growth(curves: Mapping[str, Mapping[str, Any]], title: str) -> bytes:
    """A panel for each curve, both axes logarithmic: every cost relative to its smallest.

    ``curves``: by name the ``work`` (a list), its ``unit``, and ``costs``, lists by name. A dotted
    line shows what linear growth would be.
    """
    with matplotlib.rc_context(matplotlib.rcParamsDefault):
        figure = Figure(figsize=(3.6 * len(curves), 3.6), dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(1, len(curves), squeeze=False)[0]
        for panel, (name, curve) in zip(panels, curves.items(), strict=True):
            work = curve["work"]
            linear = [value / work[0] for value in work]
            panel.plot(work, linear, ":", color="gray", label="linear")
            for color, (cost, values) in zip(COLORS, curve["costs"].items(), strict=False):
                relative = [value / max(min(values), 1e-12) for value in values]
                panel.plot(work, relative, color=color, marker="o", markersize=3, label=cost)
            panel.set(xscale="log", yscale="log", title=name, xlabel=curve["unit"])
            panel.set_xticks(work, [f"{value:,}" for value in work], rotation=30, ha="right")
            panel.set_xticks([], minor=True)
            panel.yaxis.set_major_formatter("{x:g}")
            panel.yaxis.set_minor_formatter(NullFormatter())
            panel.grid(alpha=0.3, which="both")
        panels[0].set_ylabel("times the least")
        panels[0].legend(loc="best", fontsize="small")
        figure.suptitle(title, fontsize="medium")
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()
