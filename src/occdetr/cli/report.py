"""The tables that ``evaluate`` prints, in percent, and the files of the confusion matrix."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from occdetr.classes import CLASS_NAMES, NUM_CLASSES
from occdetr.drawing.confusion import draw_confusion
from occdetr.evaluation.distance import BANDS
from occdetr.evaluation.object_errors import CAUSES, OUTCOMES
from occdetr.evaluation.substitution import PREDICTION_PARTS
from occdetr.evaluation.upper_bound import LIMITS
from occdetr.files import write_atomically, write_image

COMPLETION_ROWS = {
    "mIoU": f"mIoU ({NUM_CLASSES - 1} classes)",
    "mIoU_present": "mIoU (classes present)",
    "IoU": "IoU (occupied)",
    "precision": "precision (occupied)",
    "recall": "recall (occupied)",
}
DETECTION_ROWS = {
    "AP50": "AP50 (2D boxes)",
    "mAP": "mAP (2D boxes)",
    "recall3d_25": "recall (3D boxes, IoU 0.25)",
}


def print_metrics(metrics: dict[str, Any], confusion: Int[np.ndarray, "band class class"]) -> None:
    """Print all scores and the IoU of each class, over all distances and for each band.

    ``confusion`` (band, prediction, truth) says which classes occur; the others get a dash.
    """
    detection = {name: _percent(metrics[key]) for key, name in DETECTION_ROWS.items()}
    print_completion(metrics, confusion, detection)


def print_completion(
    metrics: dict[str, Any],
    confusion: Int[np.ndarray, "band class class"],
    further: Mapping[str, str] | None = None,
) -> None:
    """``print_metrics`` without detection; ``further`` rows by name."""
    title = f"{metrics['num_frames']} frames, split {metrics['split']}, in %"
    table = _table(title, ["", "all", *BANDS])
    columns = [metrics, *(metrics["by_distance"][band] for band in BANDS)]
    for key, name in COMPLETION_ROWS.items():
        table.add_row(name, *[_percent(scores[key]) for scores in columns])
    table.add_section()
    for row in (further or {}).items():
        table.add_row(*row)
    table.add_section()
    truth = np.concatenate([confusion.sum(axis=(0, 1))[None], confusion.sum(axis=1)])
    for index, name in enumerate(CLASS_NAMES[1:], start=1):
        pairs = zip(columns, truth[:, index], strict=True)
        table.add_row(name, *[_percent(c["per_class"][name]) if n else "-" for c, n in pairs])
    Console().print(table)


def print_rays(scores: dict[str, Any]) -> None:
    """Print RayIoU, and that of each class that occurs."""
    table = _table("RayIoU, in %: the first surface on each ray, within metres", ["", ""])
    for name in [key for key in scores if key.startswith("RayIoU")]:
        table.add_row(name, _percent(scores[name]))
    table.add_section()
    for name, value in scores["per_class"].items():
        if value is not None:
            table.add_row(name, _percent(value))
    Console().print(table)


def print_recall(objects_found: dict[str, Any]) -> None:
    """Print the recall by class and distance; ``objects_found`` is that of ``DetectionRecall``."""
    if not objects_found:
        return
    title = "objects found, in %: in 2D (IoU 0.5) / in 3D (IoU 0.25), of how many"
    table = _table(title, ["", "all", *BANDS])
    keys = ("objects", "found2d_50", "found3d_25")
    counts = {
        name: np.array([[bands[band][key] for key in keys] for band in BANDS])
        for name, bands in objects_found.items()
    }
    for name, by_band in [*counts.items(), ("all", sum(counts.values()))]:
        if name == "all":
            table.add_section()
        rows = [by_band.sum(axis=0), *by_band]
        shares = [
            f"{100 * found_2d / n:.0f}/{100 * found_3d / n:.0f} of {n}" if n else "-"
            for n, found_2d, found_3d in rows
        ]
        table.add_row(name, *shares)
    Console().print(table)


def print_diagnosis(diagnosis: dict[str, Any]) -> None:
    """Print what substituting each part by the truth gains, the object errors, and the advice."""
    before, console = diagnosis["as_predicted"], Console()
    columns = ["", "mIoU", "gain", "SC IoU", "gain"]
    table = _table("with one part true, the largest gain first, in %", columns)
    table.add_row(*_gain_row("as predicted", before, before))
    alone = sorted(diagnosis["alone"].items(), key=lambda item: -item[1]["mIoU"])
    for part, scores in alone:
        table.add_row(*_gain_row(part, scores, before))
    console.print(table)
    table = _table("with one more part true in each row, in %", columns)
    table.add_row(*_gain_row("as predicted", before, before))
    previous = before
    for part, scores in diagnosis["together"].items():
        table.add_row(*_gain_row(f"+ {part}", scores, previous))
        previous = scores
    console.print(table)
    if diagnosis["objects"]:
        _print_object_errors(console, diagnosis)
    for part in diagnosis["alone"]:
        console.print(f"{part}: {PREDICTION_PARTS[part]}", soft_wrap=True)
    console.print(diagnosis["advice"], soft_wrap=True)


def _gain_row(name: str, scores: dict[str, Any], before: dict[str, Any]) -> list[str]:
    cells = [name]
    for key in ("mIoU", "IoU"):
        gain = "" if scores is before else f"{100 * (scores[key] - before[key]):+.2f}"
        cells += [_percent(scores[key]), gain]
    return cells


def _print_object_errors(console: Console, diagnosis: dict[str, Any]) -> None:
    """Objects of each class by error, and wrong voxels by the error that they come from."""
    names = [*OUTCOMES, "background"]
    columns = ["", *OUTCOMES, "back-\nground"]
    table = _table("objects by error; wrong voxels by the error that causes them", columns)
    for name, counts in diagnosis["objects"].items():
        table.add_row(name, *[str(counts.get(key, "")) for key in names])
    table.add_section()
    for key, name in (("lost", "lost voxels"), ("invented", "false voxels")):
        by_class = diagnosis[key].values()
        sums = {cause: sum(counts[cause] for counts in by_class) for cause in CAUSES}
        table.add_row(name, *[f"{sums[column]:,}" if column in sums else "" for column in names])
    console.print(table)


def print_upper_bounds(report: dict[str, Any]) -> None:
    """Print the upper bounds: a column for each loss alone, and one for all of them together."""
    title = f"{report['model']}, {report['partition']}: {report['num_frames']} frames, in %"
    variants = report["variants"]
    table = _table(title, ["", *variants])
    rows = {"mIoU_present": "mIoU, present", "mIoU": "mIoU", "IoU": "SC IoU"}
    for key, name in rows.items():
        table.add_row(name, *[_percent(scores[key]) for scores in variants.values()])
    table.add_section()
    for name in CLASS_NAMES[1:]:
        table.add_row(name, *[_percent(scores["per_class"][name]) for scores in variants.values()])
    console = Console()
    console.print(table)
    for name, meaning in LIMITS.items():
        console.print(f"{name}: {meaning}")


def _table(title: str, columns: Sequence[str]) -> Table:
    """A table with the names of its rows on the left and numbers on the right."""
    table = Table(title=title, box=SIMPLE, pad_edge=False, collapse_padding=True)
    for number, name in enumerate(columns):
        table.add_column(name, justify="right" if number else "left", no_wrap=number == 0)
    return table


def _percent(share: float) -> str:
    return f"{100 * share:.2f}"


def write_confusion(folder: Path, confusion: Int[np.ndarray, "class class"]) -> None:
    """Write ``confusion.png`` and ``confusion.csv``, both with the truth in rows.

    ``confusion``: rows prediction, columns truth, as everywhere else.
    """
    write_image(folder / "confusion.png", draw_confusion(confusion))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["truth \\ prediction", *CLASS_NAMES])
    for name, row in zip(CLASS_NAMES, confusion.T.tolist(), strict=True):
        writer.writerow([name, *row])
    write_atomically(folder / "confusion.csv", text.getvalue().encode())
