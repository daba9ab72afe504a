"""The rows of a summary: what was different between the runs, and what came out."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.box import SIMPLE
from rich.table import Table

from occdetr.errors import InputError
from occdetr.summarize.runs import BROKEN, FINISHED, TrainingRun
from occdetr.training.compare_settings import select

#: Settings that are no difference between runs: where they are, and how they were started.
_PLACES = ("hydra", "outputs", "resume", "data.root", "data.cache_dir", "data.num_workers")
#: Figures of which less is better have this in their names.
_LOSS = "loss"


@dataclass(frozen=True)
class Row:
    """One run: its name, the settings that differ, and its best and last validation."""

    run: TrainingRun
    name: str
    settings: Mapping[str, Any]
    metric: str

    @property
    def points(self) -> list[tuple[float, float]]:
        """(step, figure) of every validation that has the metric."""
        found = self.run.validations
        return [(v["step"], v[self.metric]) for v in found if self.metric in v]

    @property
    def best(self) -> tuple[float, float] | None:
        choose = min if _LOSS in self.metric else max
        real = [point for point in self.points if point[1] == point[1]]
        return choose(real, key=lambda point: point[1], default=None)

    def cells(self) -> dict[str, Any]:
        """What ``summary.csv`` and ``summary.json`` have of the run."""
        step, best = self.best or (None, None)
        steps = [validation["step"] for validation in self.run.validations]
        return {
            "run": self.name,
            "state": self.run.state,
            **self.settings,
            "steps": self.run.summary.get("steps", max(steps, default=None)),
            "seconds": self.run.summary.get("seconds"),
            f"best {self.metric}": best,
            "best step": step,
            f"last {self.metric}": self.points[-1][1] if self.points else None,
            "problem": self.run.problem,
        }


def make_rows(runs: Sequence[TrainingRun], metric: str | None) -> list[Row]:
    """The runs, the best first; those without the metric follow, and broken ones come last.

    Raises ``InputError`` if no validation has the metric, or several are meant by none given.
    """
    chosen = choose_metric(runs, metric)
    columns = differing_settings(runs)
    names = _short_names(runs)
    rows = [
        Row(run, name, {key: values[number] for key, values in columns.items()}, chosen)
        for number, (run, name) in enumerate(zip(runs, names, strict=True))
    ]
    sign = 1 if _LOSS in chosen else -1
    return sorted(
        rows,
        key=lambda row: (
            row.run.state == BROKEN,
            row.best is None,
            sign * row.best[1] if row.best else 0,
        ),
    )


def choose_metric(runs: Sequence[TrainingRun], metric: str | None) -> str:
    known = {name: None for run in runs for each in run.validations for name in each}
    known.pop("step", None)
    if metric is not None:
        name = metric.removeprefix("val/")
        if known and name not in known:
            raise InputError(f"metric={metric}: no run has it: choose one of {', '.join(known)}")
        return name
    monitors = list(dict.fromkeys(run.monitor for run in runs if run.monitor))
    if len(monitors) > 1:
        raise InputError(
            f"metric: the runs have several ({', '.join(monitors)}): give one, as in "
            f"metric={monitors[0]}"
        )
    return monitors[0] if monitors else "mIoU"


def differing_settings(runs: Sequence[TrainingRun]) -> dict[str, list[Any]]:
    """What the runs' users have typed that is not the same for all, by setting: a value a run."""
    keys = dict.fromkeys(_key(text) for run in runs for text in run.overrides)
    columns = {
        key: [_value(run, key) for run in runs] for key in keys if not key.startswith(_PLACES)
    }
    return {key: values for key, values in columns.items() if len(set(map(str, values))) > 1}


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def _value(run: TrainingRun, key: str) -> Any:
    """The option of a group, else the setting; as it was typed, if the configuration lacks it."""
    if not run.config:
        return None
    value = run.choices.get(key, select(run.config, key))
    typed = [text.partition("=")[2] for text in run.overrides if _key(text) == key]
    return typed[-1] if value is None and typed else value


def _short_names(runs: Sequence[TrainingRun]) -> list[str]:
    """The folders without what all of them have in common."""
    parts = [run.folder.absolute().parts for run in runs]
    shared = 0
    while all(len(each) > shared + 1 and each[shared] == parts[0][shared] for each in parts):
        shared += 1
    return ["/".join(each[shared:]) for each in parts]


def to_csv(rows: Sequence[Row]) -> bytes:
    text = io.StringIO()
    cells = [row.cells() for row in rows]
    writer = csv.DictWriter(text, list(cells[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(cells)
    return text.getvalue().encode()


def to_table(rows: Sequence[Row]) -> Table:
    """The same for the screen, figures in percent."""
    metric = rows[0].metric
    names = [*rows[0].settings, "steps", "minutes", f"best {metric}", "at step", f"last {metric}"]
    title = f"{len(rows)} runs by {metric}, in %"
    table = Table(title=title, box=SIMPLE, pad_edge=False, collapse_padding=True)
    for number, name in enumerate(["", "run", *names, "state"]):
        left = 1 <= number <= 1 + len(rows[0].settings) or name == "state"
        table.add_column(name, justify="left" if left else "right", no_wrap=number < 2)
    for number, row in enumerate(rows, start=1):
        cells = row.cells()
        figures = [_percent(cells[f"best {metric}"]), _shown(cells["best step"])]
        seconds = cells["seconds"]
        table.add_row(
            *(str(number), row.name, *[_shown(value) for value in row.settings.values()]),
            *(_shown(cells["steps"]), "-" if seconds is None else f"{seconds / 60:.1f}"),
            *(*figures, _percent(cells[f"last {metric}"])),
            row.run.problem or ("" if row.run.state == FINISHED else row.run.state),
        )
    return table


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return "-" if value is None else str(value)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f}"
