"""Whether the quantities of a long run grow: their trends, as a table and as a picture."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import theilslopes
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

UNITS = {
    "main memory": "MiB, main process",
    "memory": "MiB, all processes",
    "handles": "open handles",
    "threads": "threads",
    "disk": "MiB, run folder",
    "step": "seconds a step",
}
START = 0.1  # of the time is left out: caches and allocators fill
FLAT = 0.05  # of the median: what a quantity may grow by over the rest
LEAST_POINTS = 10  # fewer make no trend
MOST_POINTS = 1500  # of a trend: its slope is the median over all pairs of points


@dataclass(frozen=True)
class Trend:
    """A quantity of a run: the median, and the ``growth`` from the start to the end of its trend,
    as a share of the median. The trend is the line of Theil and Sen, which outliers do not move."""

    name: str
    samples: int
    hours: float
    median: float
    growth: float
    intercept: float
    slope: float

    @property
    def flat(self) -> bool:
        return self.growth < FLAT


def trends(folder: Path) -> list[Trend]:
    """The trend of every quantity that was sampled often enough."""
    found = series(folder).items()
    return [trend(name, *points) for name, points in found if len(points[0]) >= LEAST_POINTS]


def trend(name: str, hours: np.ndarray, values: np.ndarray) -> Trend:
    """Of the points after the first ``START`` of the time."""
    late = hours >= hours[0] + START * (hours[-1] - hours[0])
    hours, values = hours[late], values[late]
    chosen = np.unique(np.linspace(0, len(hours) - 1, MOST_POINTS).astype(int))
    line: Any = theilslopes(values[chosen], hours[chosen])
    slope, intercept = float(line.slope), float(line.intercept)
    median, length = float(np.median(values)), float(hours[-1] - hours[0])
    growth = slope * length / median if median else 0.0
    return Trend(name, len(hours), length, median, growth, intercept, slope)


def series(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """(hours, values) of each quantity from the end of the first validation on, which starts the
    last processes; of a run without one, from the first training step on."""
    with (folder / "samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    run = folder / "run" / "tensorboard"
    steps = [(event.wall_time, event.value) for event in _scalars(run, "time/step")]
    validations = [event.wall_time for event in _scalars(run, "val/AP50")]
    begin = min(validations or [time for time, _ in steps] or [float(rows[0]["time"])])
    steps = [(time, value) for time, value in steps if time >= begin]
    rows = [row for row in rows if float(row["time"]) >= begin]
    hours = np.array([float(row["time"]) - begin for row in rows]) / 3600
    found = {n: (hours, np.array([float(row[n]) for row in rows])) for n in UNITS if n != "step"}
    if steps:
        found["step"] = (np.array([t - begin for t, _ in steps]) / 3600, np.array(steps)[:, 1])
    return found


def _scalars(run: Path, name: str) -> list[Any]:
    if not run.exists():
        return []
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    return events.Scalars(name) if name in events.Tags()["scalars"] else []


def table(found: Sequence[Trend]) -> str:
    lines = ["| quantity | median | growth, % | hours | samples | |", "| --- " * 6 + "|"]
    for each in found:
        lines.append(
            f"| {UNITS[each.name]} | {each.median:.4g} | {100 * each.growth:+.2f} | "
            f"{each.hours:.2f} | {each.samples} | {'flat' if each.flat else 'GROWS'} |"
        )
    return "\n".join(lines)


def draw(found: Sequence[Trend], folder: Path) -> bytes:
    """A panel for each quantity: its samples, and its trend as a line; as PNG."""
    points = series(folder)
    with matplotlib.rc_context(matplotlib.rcParamsDefault):
        figure = Figure(figsize=(10, 5.2), dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        for each, panel in zip(found, figure.subplots(2, 3).flat, strict=False):
            hours, values = points[each.name]
            panel.plot(hours, values, ".", markersize=2, color="#56b4e9")
            ends = np.array([hours[-1] - each.hours, hours[-1]])
            panel.plot(ends, each.intercept + each.slope * ends, color="#d55e00", linewidth=1.5)
            top = max(1.2 * np.quantile(values, 0.99), 1e-3)
            panel.set(xlabel="hours", ylabel=UNITS[each.name], ylim=(0, top))
            panel.set_title(f"{100 * each.growth:+.1f} %", fontsize="small")
            panel.grid(alpha=0.3)
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()
