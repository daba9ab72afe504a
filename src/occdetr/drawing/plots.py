"""Plots with axes, as PNG files whose bytes depend only on the figures."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler

#: Okabe-Ito, for the colour-blind; further curves have them again, dashed, then dotted.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#5a5a5a")
STYLES = cycler(linestyle=["-", "--", ":"]) * cycler(color=COLORS)


def plot_panels(
    draw: Callable[[list[Axes]], None], count: int, size: tuple[float, float], title: str
) -> bytes:
    """``count`` panels beside each other, each of ``size`` (width, height) in inches, as PNG.

    ``draw`` draws on them. What they name (``label``) is listed below them.
    """
    settings: Any = {"axes.prop_cycle": STYLES, "text.parse_math": False}  # names may have a $
    with matplotlib.rc_context(matplotlib.rcParamsDefault | settings):
        width, height = size
        figure = Figure(figsize=(width * count, height), dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        panels = list(figure.subplots(1, count, squeeze=False)[0])
        draw(panels)
        for panel in panels:
            panel.grid(alpha=0.3, which="both")
        lines, names = panels[0].get_legend_handles_labels()
        if lines:
            columns = len(names) if len("".join(names)) < 80 else 1
            figure.legend(lines, names, loc="outside lower center", ncols=columns, fontsize="small")
        figure.suptitle(title, fontsize="medium")
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()
