"""The Markdown tables of the studies, from their records (``docs/results/<study>/*.json``).

A cell holds the mean over seeds (or splits) and, from two on, their standard deviation (n - 1).
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from occdetr.classes import CLASS_NAMES

#: Records by arm, each arm's by seed.
Records = Mapping[str, Mapping[int, Mapping[str, Any]]]

SMALL_CLASSES = (
    *("bicycle", "motorcycle", "person", "bicyclist", "motorcyclist", "pole", "traffic-sign"),
)


def spread(values: Sequence[float], scale: float = 100.0, digits: int = 1) -> str:
    """Mean and standard deviation; a dash where there is nothing."""
    scaled = [scale * value for value in values]
    if not scaled:
        return "-"
    mean = f"{statistics.mean(scaled):.{digits}f}"
    return mean if len(scaled) == 1 else f"{mean} ± {statistics.stdev(scaled):.{digits}f}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def figures(records: Mapping[int, Mapping[str, Any]], key: str) -> list[float]:
    """A final figure of one arm, by seed."""
    return [record["figures"][key] for record in records.values()]


def small_classes(record: Mapping[str, Any]) -> float:
    """Mean IoU of the classes of thin and small things."""
    return statistics.mean(record["figures"]["per_class"][name] for name in SMALL_CLASSES)


def minutes(records: Mapping[int, Mapping[str, Any]]) -> str:
    return spread([record["seconds"] for record in records.values()], 1 / 60, 0)


def steps(records: Mapping[int, Mapping[str, Any]]) -> str:
    return " or ".join(f"{n:,}" for n in sorted({r["steps"] for r in records.values()})) or "-"


def mean_curve(
    records: Mapping[int, Mapping[str, Any]], key: str, frames: bool = False
) -> dict[int, list[float]]:
    """A figure's values by step, or by training frames seen, at the validations that every seed
    of an arm has.
    """
    curves = [
        {frames_seen(r, p["step"]) if frames else p["step"]: p[key] for p in r["curve"] if key in p}
        for r in records.values()
    ]
    shared = set.intersection(*map(set, curves)) if curves else set()
    return {place: [curve[place] for curve in curves] for place in sorted(shared)}


def frames_seen(record: Mapping[str, Any], step: int) -> int:
    """Training frames of the first ``step`` steps, through stages of different batch sizes."""
    frames = 0
    for stage in record["stages"].values():
        own = min(step, stage["steps"])
        frames += own * stage["batch_size"]
        step -= own
    return frames


def convergence(records: Records) -> list[str]:
    """Final detection figures, AP50 over steps, and the paper's two claims in numbers."""
    curves = {arm: mean_curve(records[arm], "AP50") for arm in records}
    rows = []
    for arm, own in records.items():
        shown = [spread(figures(own, key)) for key in ("AP50", "mAP", "recall3d_25")]
        rows.append([f"`{arm}`", *shown, steps(own), minutes(own)])
    header = ["arm", "AP50", "mAP", "3D recall", "steps", "minutes of training"]
    every = sorted(set().union(*curves.values()))
    over_steps = [
        [f"{step:,}", *[spread(curve.get(step, [])) for curve in curves.values()]] for step in every
    ]
    names = [f"`{arm}`" for arm in records]
    lines = [*table(header, rows), "", "AP50 at the validations on the way:", ""]
    return [*lines, *table(["step", *names], over_steps), *convergence_claims(curves)]


def convergence_claims(curves: Mapping[str, Mapping[int, list[float]]]) -> list[str]:
    """How soon early matching reaches ``two_stage``'s last AP50, and whether it leads ``mixed``."""
    means = {
        arm: {step: statistics.mean(values) for step, values in curve.items()}
        for arm, curve in curves.items()
        if curve
    }
    early, lines = means.get("early_matching"), [""]
    if early and "two_stage" in means:
        last = max(means["two_stage"])
        goal = means["two_stage"][last]
        reached = [step for step, value in early.items() if value >= goal]
        when = (
            f"after {reached[0]:,} of its {last:,} steps ({100 * reached[0] / last:.0f} %)"
            if reached
            else "at no validation"
        )
        lines.append(f"- Early matching reaches `two_stage`'s last AP50 ({100 * goal:.1f}) {when}.")
    if early and "mixed" in means:
        shared = sorted(set(early) & set(means["mixed"]))
        above = [step for step in shared if early[step] > means["mixed"][step]]
        lines.append(
            f"- Early matching is above `mixed` selection at {len(above)} of {len(shared)} "
            "validations."
        )
    return lines if len(lines) > 1 else []


def partition(records: Records) -> list[str]:
    """The paper's Table I: figures, cost, IoU by class, and the ratios that it claims."""
    rows = []
    for arm, own in records.items():
        runs = list(own.values())
        latency = [run["latency"]["latency_ms"] for run in runs if "latency" in run]
        cost = [spread(latency, 1, 0), spread([run["peak_memory_mb"] for run in runs], 1, 0)]
        shown = [spread(figures(own, key)) for key in ("mIoU", "IoU")]
        small = spread([small_classes(run) for run in runs], 100, 2)
        rows.append([f"`{arm}`", *shown, small, *cost, steps(own), minutes(own)])
    header = ["arm", "mIoU", "SC IoU", "small classes", "latency, ms", "training memory, MiB"]
    per_class = [
        [
            name,
            *[
                spread([r["figures"]["per_class"][name] for r in own.values()])
                for own in records.values()
            ],
        ]
        for name in CLASS_NAMES[1:]
    ]
    return [
        *table([*header, "steps", "minutes of training"], rows),
        *["", f"Small classes: mean IoU of {', '.join(SMALL_CLASSES)}. IoU by class:", ""],
        *table(["class", *[f"`{arm}`" for arm in records]], per_class),
        *partition_claims(records),
    ]


def partition_claims(records: Records) -> list[str]:
    """``mixed`` over the other partitions, as ratios of means."""
    lines = [""]
    measures: dict[str, Callable[[Mapping[str, Any]], float]] = {
        "mIoU": lambda record: record["figures"]["mIoU"],
        "small classes": small_classes,
    }
    for name, measure in measures.items():
        means = {a: statistics.mean(map(measure, r.values())) for a, r in records.items() if r}
        for other in ("all_foreground", "all_background"):
            if "mixed" in means and other in means:
                own, theirs = means["mixed"], means[other]
                share = (
                    f"{own / theirs:.2f} times that of `{other}`"
                    if own < 100 * theirs
                    else f"{100 * own:.2f} %, `{other}` {100 * theirs:.2g}"
                )
                lines.append(f"- {name}: `mixed` has {share}.")
    return lines if len(lines) > 1 else []


def real(records: Records) -> list[str]:
    """Means over the splits, and the mIoU of each split."""
    keys = ("mIoU_present", "IoU")
    rows = [
        [f"`{arm}`", str(len(own)), *[spread(figures(own, key)) for key in keys], minutes(own)]
        for arm, own in records.items()
    ]
    header = ["arm", "splits", "mIoU (classes present)", "SC IoU", "minutes of training"]
    splits = sorted(set().union(*records.values()))
    by_split = [
        [str(split)]
        + [
            spread(figures({split: own[split]}, "mIoU_present")) if split in own else "-"
            for own in records.values()
        ]
        for split in splits
    ]
    return [
        *table(header, rows),
        *["", "mIoU (classes present) by split:", ""],
        *table(["split", *[f"`{arm}`" for arm in records]], by_split),
        *real_claims(records),
    ]


def real_claims(records: Records) -> list[str]:
    """``finetuned`` less every other arm, split by split."""
    lines, own = [""], completion_by_split(records.get("finetuned", {}))
    for arm, others in records.items():
        theirs = completion_by_split(others)
        gains = [own[split] - theirs[split] for split in sorted(own.keys() & theirs.keys())]
        if arm != "finetuned" and gains:
            ahead = sum(gain > 0 for gain in gains)
            lines.append(
                f"- mIoU: `finetuned` less `{arm}` is {spread(gains)}; it is ahead in {ahead} of "
                f"{len(gains)} splits."
            )
    return lines if len(lines) > 1 else []


def completion_by_split(records: Mapping[int, Mapping[str, Any]]) -> dict[int, float]:
    """mIoU of the classes present."""
    return {split: record["figures"]["mIoU_present"] for split, record in records.items()}


TABLES: dict[str, Callable[[Records], list[str]]] = {
    "convergence": convergence,
    "partition": partition,
    "real": real,
}
