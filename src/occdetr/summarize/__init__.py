"""The runs of a sweep as a table: ``python -m occdetr.summarize runs=outputs/full metric=mIoU``.

``occdetr summarize outputs/full`` is the same.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence

from omegaconf import DictConfig
from rich.console import Console

from occdetr.cli import entry as cli
from occdetr.cli.overrides import literal
from occdetr.drawing.curves import Curve, draw_curves
from occdetr.errors import InputError
from occdetr.files import write_atomically, write_json
from occdetr.summarize.runs import CONTINUED, FINISHED, find_runs
from occdetr.summarize.table import Row, make_rows, to_csv, to_table


def main() -> None:
    """Print the table; write ``summary.csv``, ``.json`` and ``.png`` to this command's folder."""
    sys.argv[1:] = complete_overrides(sys.argv[1:])
    summarize()


def complete_overrides(words: Sequence[str]) -> list[str]:
    """The command line as Hydra takes it: a folder alone becomes ``runs=...``, any folder quoted
    where Hydra would read something else."""
    first = [f"runs={word}" if "=" not in word and word[:1] != "-" else word for word in words[:1]]
    words = [*first, *words[1:]]
    return [f"runs={literal(word[5:])}" if word.startswith("runs=") else word for word in words]


@cli.entry_point("summarize")
def summarize(config: DictConfig) -> None:
    """Summarize the trainings below ``runs``."""
    if not isinstance(config.runs, str):
        raise InputError(f"runs={config.runs}: give a folder, or a quoted pattern of folders")
    rows = make_rows(find_runs(config.runs), config.metric)
    folder, metric = cli.run_folder(), rows[0].metric
    Console(width=None if sys.stdout.isatty() else 160).print(to_table(rows))
    write_atomically(folder / "summary.csv", to_csv(rows))
    write_json(folder / "summary.json", {"metric": metric, "runs": [row.cells() for row in rows]})
    drawn = [row for row in rows if row.points and row.run.state != CONTINUED][: config.curves]
    if drawn:
        curves = {
            f"{rows.index(row) + 1}: {_label(row)}": Curve([(x, 100 * y) for x, y in row.points])
            for row in drawn
        }
        picture = draw_curves({f"{metric}, %": curves}, "steps", config.runs)
        write_atomically(folder / "summary.png", picture)
    counts = Counter(row.run.state for row in rows)
    others = "".join(f", {n} {state}" for state, n in counts.items() if state != FINISHED)
    print(f"done: {counts[FINISHED]} finished{others}; summary.csv in {cli.shown(folder)}")


def _label(row: Row) -> str:
    """The settings that tell a run from the others; its name, if there are none."""
    return ", ".join(f"{key}={value}" for key, value in row.settings.items()) or row.name
