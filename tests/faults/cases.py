"""One injection after another into the same task, until the task ends: a case, and its report."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from faults.bench import Bench, file_name, remove, temporary_files
from faults.processes import Run


class Lost(Exception):
    """A fault was not survived; the text says what was lost and where to look."""


@dataclass
class Report:
    """What a case has shown: how often it injected its fault, and everything that was lost.

    ``orphans``: processes that had not ended 20 s after their parent. ``temporary``: files that a
    killed process had begun to write, and that were still there when the task had ended.
    """

    injected: int = 0
    lost: list[str] = field(default_factory=list)
    orphans: int = 0
    temporary: int = 0
    seconds: float = 0.0
    notes: list[str] = field(default_factory=list)

    def add(self, other: Report) -> None:
        self.injected += other.injected
        self.lost += other.lost
        self.orphans += other.orphans
        self.temporary += other.temporary
        self.seconds += other.seconds
        self.notes += other.notes


@dataclass(frozen=True)
class Case:
    """``inject(bench, generator, place, report)``: a fault injected ``count`` times.

    Cases of the same ``fault`` make one row of the table. All that is random in a case is drawn
    from a generator of its ``name`` and the seed of the program.
    """

    fault: str
    name: str
    inject: Callable[[Bench, random.Random, Path, Report], None]

    def run(self, bench: Bench, seed: int) -> Report:
        report, began = Report(), time.monotonic()
        place = bench.folder / "cases" / file_name(self.name)
        remove(place)
        try:
            self.inject(bench, random.Random(f"{seed}/{self.name}"), place, report)
        except Lost as error:
            report.lost.append(str(error))
        except Exception as error:  # of this program; the other cases go on
            report.lost.append(f"{type(error).__name__}: {error}")
        report.lost = [f"{self.name}: {text}" for text in report.lost]
        report.seconds = time.monotonic() - began
        if not report.lost:
            remove(place)
        return report


def note_remains(runs: Sequence[Run], place: Path, report: Report) -> None:
    """Count what a finished task has left behind."""
    orphans = sum(run.orphans() for run in runs)
    if orphans:
        report.lost.append(f"{orphans} processes outlived their parent")
    report.orphans += orphans
    report.temporary += len(temporary_files(place))


def check_user_error(run: Run, codes: Sequence[int], *words: str) -> None:
    """Raises ``Lost`` unless a run has ended as for an error that the user can fix.

    That is with one of the exit ``codes`` and without a traceback; the last line starts with
    "error: " and has the ``words``.
    """
    if run.code is None:
        run.kill()
        raise Lost(f"{run.err}: it hangs")
    text = run.err.read_text(errors="replace")
    lines = text.strip().splitlines()
    if run.code not in codes:
        raise Lost(f"{run.err}: exit code {run.code}, not one of {codes}: {lines[-1:]}")
    if "Traceback" in text:
        raise Lost(f"{run.err}: a traceback")
    if not lines or not lines[-1].startswith("error: "):
        raise Lost(f"{run.err}: no line of an error at the end")
    missing = [word for word in words if word not in lines[-1]]
    if missing:
        raise Lost(f"{run.err}: {lines[-1]!r} does not name the {missing[0]}")
