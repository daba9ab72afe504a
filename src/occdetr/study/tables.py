"""The Markdown tables of the studies, from their records (``docs/results/<study>/*.json``).

A cell holds the mean over seeds (or splits) and, for two or more of them, their standard deviation
(n - 1).
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from occdetr.classes import CLASS_NAMES

#: Records by arm and seed.
Records = Mapping[str, Mapping[int, Mapping[str, Any]]]

SMALL_CLASSES = (
    *("bicycle", "motorcycle", "person", "bicyclist", "motorcyclist", "pole", "traffic-sign"),
)
#: Scores that the tables of a study take, by their path in a record's figures.
SCORES = {
    "convergence": ("AP50", "mAP", "recall3d_25"),
    "partition": ("mIoU", "IoU", *(f"per_class.{name}" for name in CLASS_NAMES[1:])),
    "real": ("mIoU_present", "IoU", "AP50"),
}
#: Scores that are plotted, by study, and the names of their axes.
CURVES = {
    "convergence": {"AP50": "AP50, %", "mAP": "mAP, %"},
    "partition": {"mIoU": "mIoU, %", "IoU": "SC IoU, %"},
}


def spread(values: Sequence[float], scale: float = 100.0, digits: int = 1) -> str:
    """Mean and standard deviation of ``values`` times ``scale``; a dash for no values."""
    scaled = [scale * value for value in values]
    if not scaled:
        return "-"
    mean = f"{statistics.mean(scaled):.{digits}f}"
    return mean if len(scaled) == 1 else f"{mean} ± {statistics.stdev(scaled):.{digits}f}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def figures(records: Mapping[int, Mapping[str, Any]], key: str) -> list[float]:
    """A final score of one arm, of each seed."""
    return [record["figures"][key] for record in records.values()]


def small_classes(record: Mapping[str, Any]) -> float:
    """Mean IoU over ``SMALL_CLASSES``."""
    return statistics.mean(record["figures"]["per_class"][name] for name in SMALL_CLASSES)


def minutes(records: Mapping[int, Mapping[str, Any]]) -> str:
    return spread([record["seconds"] for record in records.values()], 1 / 60, 0)


def steps(records: Mapping[int, Mapping[str, Any]]) -> str:
    return " or ".join(f"{n:,}" for n in sorted({r["steps"] for r in records.values()})) or "-"


def mean_curve(records: Mapping[int, Mapping[str, Any]], key: str) -> dict[int, list[float]]:
    """The values of a score at each validation of the last stage, by the steps of that stage.

    Only validations that all seeds of the arm share.
    """
    curves = [_last_stage_curve(record, key) for record in records.values()]
    shared = set.intersection(*map(set, curves)) if curves else set()
    return {step: [curve[step] for curve in curves] for step in sorted(shared)}


def _last_stage_curve(record: Mapping[str, Any], key: str) -> dict[int, float]:
    *earlier, last = record["stages"]
    before = sum(record["stages"][stage]["steps"] for stage in earlier)
    points = [point for point in record["curve"] if point["stage"] == last and key in point]
    return {point["step"] - before: point[key] for point in points}


def convergence(records: Records) -> list[str]:
    """Final detection scores, AP50 over steps, and the paper's two claims in numbers."""
    curves = {arm: mean_curve(records[arm], "AP50") for arm in records}
    rows = []
    for arm, runs in records.items():
        scores = [spread(figures(runs, key)) for key in ("AP50", "mAP", "recall3d_25")]
        rows.append([f"`{arm}`", *scores, steps(runs), minutes(runs)])
    header = ["arm", "AP50", "mAP", "3D recall", "steps", "minutes of training"]
    over_steps = [
        [f"{step:,}", *[spread(curve.get(step, [])) for curve in curves.values()]]
        for step in sorted(set().union(*curves.values()))
    ]
    names = [f"`{arm}`" for arm in records]
    lines = [*table(header, rows), "", "AP50 at each validation:", ""]
    return [*lines, *table(["step", *names], over_steps), *convergence_claims(curves)]


def convergence_claims(curves: Mapping[str, Mapping[int, list[float]]]) -> list[str]:
    """When early matching reaches the last AP50 of ``two_stage``, and how often it leads ``mixed``.

    ``curves``: AP50 of each seed by step, by arm. No lines if an arm that is needed has no curve.
    """
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
        lines.append(
            f"- `early_matching` reaches the last AP50 of `two_stage` ({100 * goal:.1f}) {when}."
        )
    if early and "mixed" in means:
        shared = sorted(set(early) & set(means["mixed"]))
        above = [step for step in shared if early[step] > means["mixed"][step]]
        lines.append(
            f"- `early_matching` is above `mixed` at {len(above)} of {len(shared)} validations."
        )
    return lines if len(lines) > 1 else []


def partition(records: Records) -> list[str]:
    """The paper's Table I: scores, cost, IoU by class, and the ratios that it claims."""
    rows = []
    for arm, by_seed in records.items():
        runs = list(by_seed.values())
        latency = [run["latency"]["latency_ms"] for run in runs]
        cost = [spread(latency, 1, 0), spread([run["peak_memory_mb"] for run in runs], 1, 0)]
        scores = [spread(figures(by_seed, key)) for key in ("mIoU", "IoU")]
        small = spread([small_classes(run) for run in runs], 100, 2)
        rows.append([f"`{arm}`", *scores, small, *cost, steps(by_seed), minutes(by_seed)])
    header = ["arm", "mIoU", "SC IoU", "small classes", "latency, ms", "training memory, MiB"]
    per_class = [
        [
            name,
            *[
                spread([run["figures"]["per_class"][name] for run in by_seed.values()])
                for by_seed in records.values()
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
    """The means of ``mixed`` divided by those of the other partitions."""
    lines = [""]
    measures: dict[str, Callable[[Mapping[str, Any]], float]] = {
        "mIoU": lambda record: record["figures"]["mIoU"],
        "small classes": small_classes,
    }
    for name, measure in measures.items():
        means = {a: statistics.mean(map(measure, r.values())) for a, r in records.items() if r}
        for other in ("all_foreground", "all_background"):
            if "mixed" in means and other in means:
                mixed, compared = means["mixed"], means[other]
                ratio = (
                    f"{mixed / compared:.2f} times that of `{other}`"
                    if mixed < 100 * compared  # else the ratio says little
                    else f"{100 * mixed:.2f} %, `{other}` {100 * compared:.2g} %"
                )
                lines.append(f"- {name}: `mixed` has {ratio}.")
    return lines if len(lines) > 1 else []


#: The scores of the study on real frames; an arm without a detector has no AP50.
REAL_SCORES = {"mIoU_present": "mIoU (classes present)", "IoU": "SC IoU", "AP50": "AP50"}


def real(records: Records) -> list[str]:
    """Means over the splits, and the mIoU of each split."""
    rows = [
        [
            *(f"`{arm}`", str(len(runs))),
            *[spread(list(by_split(runs, key).values())) for key in REAL_SCORES],
            minutes(runs),
        ]
        for arm, runs in records.items()
    ]
    header = ["arm", "splits", *REAL_SCORES.values(), "minutes of training"]
    miou = [by_split(runs, "mIoU_present") for runs in records.values()]
    splits = sorted(set().union(*records.values()))
    each = [
        [str(split), *[spread([arm[split]] if split in arm else []) for arm in miou]]
        for split in splits
    ]
    return [
        *table(header, rows),
        *["", "mIoU (classes present) by split:", ""],
        *table(["split", *[f"`{arm}`" for arm in records]], each),
        *real_claims(records),
    ]


def real_claims(records: Records) -> list[str]:
    """The difference of ``finetuned`` to every other arm, split by split."""
    lines = [""]
    for key, name in {**REAL_SCORES, "mIoU_present": "mIoU"}.items():
        finetuned = by_split(records.get("finetuned", {}), key)
        for arm, runs in records.items():
            other = by_split(runs, key)
            shared = sorted(finetuned.keys() & other.keys())
            gains = [finetuned[split] - other[split] for split in shared]
            if arm != "finetuned" and gains:
                ahead = sum(gain > 0 for gain in gains)
                lines.append(
                    f"- {name}: `finetuned` minus `{arm}` is {spread(gains)}; `finetuned` is "
                    f"higher in {ahead} of {len(gains)} splits."
                )
    return lines if len(lines) > 1 else []


def by_split(records: Mapping[int, Mapping[str, Any]], key: str) -> dict[int, float]:
    """A final score of one arm, of each split that has it."""
    scores = {split: record["figures"].get(key) for split, record in records.items()}
    return {split: score for split, score in scores.items() if score is not None}


TABLES: dict[str, Callable[[Records], list[str]]] = {
    "convergence": convergence,
    "partition": partition,
    "real": real,
}
