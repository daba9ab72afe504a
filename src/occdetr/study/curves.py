"""Plots of scores over steps, as PNG files whose bytes depend only on the records."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from occdetr.study.tables import Records, mean_curve

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9")  # Okabe-Ito, for the colour-blind
NAMES = {"AP50": "AP50, %", "mAP": "mAP, %", "mIoU": "mIoU, %", "IoU": "SC IoU, %"}


def draw_curves(records: Records, keys: Sequence[str], title: str) -> bytes:
    """One panel per score: a thick line for the mean over seeds, thin lines for single seeds.

    The x axis counts the steps of the last stage, since not every arm has the one before.
    """
    last = {list(run["stages"])[-1] for runs in records.values() for run in runs.values()}
    with matplotlib.rc_context(matplotlib.rcParamsDefault):
        figure = Figure(figsize=(4.5 * len(keys), 3.4), dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(1, len(keys), squeeze=False)[0]
        for key, panel in zip(keys, panels, strict=True):
            for color, (arm, runs) in zip(COLORS, records.items(), strict=False):
                _draw_arm(panel, mean_curve(runs, key), color, arm)
            steps = f"steps of stage={', '.join(sorted(last))}"
            panel.set(xlabel=steps, ylabel=NAMES[key], xlim=(0, None), ylim=(0, None))
            panel.grid(alpha=0.3)
        panels[0].legend(loc="best", fontsize="small")
        figure.suptitle(title, fontsize="medium")
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def _draw_arm(panel: Axes, curve: Mapping[int, list[float]], color: str, arm: str) -> None:
    if not curve:
        return
    x = list(curve)
    seeds = list(zip(*curve.values(), strict=True))
    for values in seeds:
        panel.plot(x, [100 * value for value in values], color=color, linewidth=0.8, alpha=0.5)
    means = [100 * sum(values) / len(values) for values in curve.values()]
    panel.plot(x, means, color=color, linewidth=2, marker="o", markersize=3, label=arm)
