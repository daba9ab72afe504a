"""What ``evaluate`` prints and draws: tables in percent, and the files of the confusion matrix."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from occdetr.classes import CLASS_NAMES
from occdetr.drawing.confusion import draw_confusion
from occdetr.evaluation.object_errors import CAUSES, OUTCOMES
from occdetr.evaluation.recall import BANDS
from occdetr.evaluation.substitution import PREDICTION_PARTS
from occdetr.evaluation.upper_bound import LIMITS
from occdetr.files import write_atomically, write_image

BY_DISTANCE = {
    "mIoU": "mIoU (19 classes)",
    "mIoU_present": "mIoU (classes present)",
    "IoU": "IoU (occupied)",
    "precision": "precision (occupied)",
    "recall": "recall (occupied)",
}
OF_OBJECTS = {
    "AP50": "AP50 (2D boxes)",
    "mAP": "mAP (2D boxes)",
    "recall3d_25": "recall (3D boxes, IoU 0.25)",
}


def print_table(metrics: dict[str, Any], confusion: Int[np.ndarray, "band 20 20"]) -> None:
    """All figures and the IoU of each class, of all distances and of each band.

    ``confusion`` (band, prediction, truth) tells which classes occur; the others have a dash.
    """
    title = f"{metrics['num_frames']} frames, split {metrics['split']}, in %"
    table = _table(title, ["", "all", *BANDS])
    columns = [metrics, *(metrics["by_distance"][band] for band in BANDS)]
    for key, name in BY_DISTANCE.items():
        table.add_row(name, *[_percent(scores[key]) for scores in columns])
    table.add_section()
    for key, name in OF_OBJECTS.items():
        table.add_row(name, _percent(metrics[key]))
    table.add_section()
    truth = np.concatenate([confusion.sum(axis=(0, 1))[None], confusion.sum(axis=1)])
    for index, name in enumerate(CLASS_NAMES[1:], start=1):
        pairs = zip(columns, truth[:, index], strict=True)
        table.add_row(name, *[_percent(c["per_class"][name]) if n else "-" for c, n in pairs])
    Console().print(table)


def print_found(objects_found: dict[str, Any]) -> None:
    """Objects found by class and distance, as ``DetectionRecall`` counts them."""
    if not objects_found:
        return
    title = "objects found, in %: in 2D (IoU 0.5) / in 3D (IoU 0.25), of how many"
    table = _table(title, ["", "all", *BANDS])
    keys = ("objects", "found2d_50", "found3d_25")
    counts = {
        name: np.array([[bands[band][key] for key in keys] for band in BANDS])
        for name, bands in objects_found.items()
    }
    for name, of_class in [*counts.items(), ("all", sum(counts.values()))]:
        if name == "all":
            table.add_section()
        rows = [of_class.sum(axis=0), *of_class]
        shares = [
            f"{100 * plane / n:.0f}/{100 * space / n:.0f} of {n}" if n else "-"
            for n, plane, space in rows
        ]
        table.add_row(name, *shares)
    Console().print(table)


def print_diagnosis(causes: dict[str, Any]) -> None:
    """What each part costs, alone and together; what became of objects and voxels; the advice."""
    before, console = causes["as_predicted"], Console()
    columns = ["", "mIoU", "gain", "SC IoU", "gain"]
    table = _table("with one part true, the largest gain first, in %", columns)
    table.add_row(*_gains("as predicted", before, before))
    alone = sorted(causes["alone"].items(), key=lambda item: -item[1]["mIoU"])
    for part, scores in alone:
        table.add_row(*_gains(part, scores, before))
    console.print(table)
    table = _table("with one more part true in each row, in %", columns)
    table.add_row(*_gains("as predicted", before, before))
    last = before
    for part, scores in causes["together"].items():
        table.add_row(*_gains(f"+ {part}", scores, last))
        last = scores
    console.print(table)
    if causes["objects"]:
        _print_errors(console, causes)
    for part in causes["alone"]:
        console.print(f"{part}: {PREDICTION_PARTS[part]}", soft_wrap=True)
    console.print(causes["advice"], soft_wrap=True)


def _gains(name: str, scores: dict[str, Any], before: dict[str, Any]) -> list[str]:
    cells = [name]
    for key in ("mIoU", "IoU"):
        gain = "" if scores is before else f"{100 * (scores[key] - before[key]):+.2f}"
        cells += [_percent(scores[key]), gain]
    return cells


def _print_errors(console: Console, causes: dict[str, Any]) -> None:
    """Objects of each class by outcome, and wrong voxels by cause."""
    names = [*OUTCOMES, "background"]
    columns = ["", *OUTCOMES, "back-\nground"]
    table = _table("what became of the objects; wrong voxels by cause", columns)
    for name, outcomes in causes["objects"].items():
        table.add_row(name, *[str(outcomes.get(key, "")) for key in names])
    table.add_section()
    for key, name in (("lost", "lost voxels"), ("invented", "false voxels")):
        sums = {cause: sum(of[cause] for of in causes[key].values()) for cause in CAUSES}
        table.add_row(name, *[f"{sums[column]:,}" if column in sums else "" for column in names])
    console.print(table)


def print_ceilings(report: dict[str, Any]) -> None:
    """Ceilings in percent: a column for each loss alone, and for all of them together."""
    title = f"{report['model']}, {report['partition']}: {report['num_frames']} frames, in %"
    variants = report["variants"]
    table = _table(title, ["", *variants])
    figures = {"mIoU_present": "mIoU, present", "mIoU": "mIoU", "IoU": "SC IoU"}
    for key, name in figures.items():
        table.add_row(name, *[_percent(v[key]) for v in variants.values()])
    table.add_section()
    for name in CLASS_NAMES[1:]:
        table.add_row(name, *[_percent(v["per_class"][name]) for v in variants.values()])
    console = Console()
    console.print(table)
    for name, meaning in LIMITS.items():
        console.print(f"{name}: {meaning}")


def _table(title: str, columns: list[str]) -> Table:
    """A table of figures, the names of its rows to the left."""
    table = Table(title=title, box=SIMPLE, pad_edge=False, collapse_padding=True)
    for number, name in enumerate(columns):
        table.add_column(name, justify="right" if number else "left", no_wrap=number == 0)
    return table


def _percent(share: float) -> str:
    return f"{100 * share:.2f}"


def write_confusion(folder: Path, confusion: Int[np.ndarray, "20 20"]) -> None:
    """``confusion.png``, and its counts as ``confusion.csv``: both with the truth in rows.

    ``confusion``: rows prediction, columns truth, as everywhere else.
    """
    write_image(folder / "confusion.png", draw_confusion(confusion))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["truth \\ prediction", *CLASS_NAMES])
    for name, row in zip(CLASS_NAMES, confusion.T.tolist(), strict=True):
        writer.writerow([name, *row])
    write_atomically(folder / "confusion.csv", text.getvalue().encode())
