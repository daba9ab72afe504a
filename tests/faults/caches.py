"""Object labels and streets whose writing is killed and continued."""

from __future__ import annotations

import itertools
import random
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from faults.bench import PATIENCE, Bench, contents
from faults.cases import Case, Report, note_remains
from faults.moments import AtRenaming, WhileWriting
from faults.processes import start

#: A way to strike: a moment inside the process, or None for a random one.
Moment = Callable[[], object] | None


@dataclass(frozen=True)
class Preparation:
    """``prepare`` killed ``count`` times, by SIGKILL at a random moment or while a file is written.

    ``kind``: "labels" of streets that are there, or "streets" from nothing.
    """

    kind: str
    workers: int
    count: int

    def __call__(self, bench: Bench, generator: random.Random, place: Path, report: Report) -> None:
        wanted, seconds = bench.prepared(self.kind)
        for number in itertools.count():
            if report.injected >= self.count or report.lost:
                return
            task, runs, code = place / f"{number}", [], -1
            given = [
                *bench.preparation(self.kind, task / self.kind, self.workers),
                f"outputs={task}",
            ]
            while code != 0 and not report.lost:
                hits = report.injected < self.count
                moment = self._moment(generator) if hits else None
                run = start("prepare", given, task / "logs" / f"{len(runs):03d}", before=moment)
                runs.append(run)
                if hits and moment is None:
                    run.wait(generator.uniform(0, seconds))
                    run.kill()
                code = run.wait(PATIENCE)
                if code in (-signal.SIGKILL, -signal.SIGXFSZ):
                    report.injected += 1
                elif code != 0:
                    report.lost.append(f"{run.err}: it ended with {code}")
            if code == 0:
                report.lost += unequal_files(task / self.kind, wanted)
            note_remains(runs, task, report)

    def _moment(self, generator: random.Random) -> Moment:
        count = generator.randint(1, 9)
        within = WhileWriting(count, share=generator.uniform(0.1, 0.95))
        return generator.choice([None, None, AtRenaming(count), within])


def unequal_files(folder: Path, wanted: dict[str, bytes]) -> list[str]:
    """The files that are missing, that are too many, or whose bytes differ."""
    found = contents(folder)
    names = found.keys() | wanted.keys()
    return [f"{folder / name} differs" for name in names if found.get(name) != wanted.get(name)]


#: Which files, how many workers, which share of the kills.
SHARES = (("labels", 1, 0.06), ("labels", 2, 0.04), ("streets", 1, 0.06), ("streets", 2, 0.04))


def cache_cases(kills: int = 100) -> list[Case]:
    """Cases with about a fifth of ``kills`` kills."""
    cases = []
    for kind, workers, share in SHARES:
        fault = f"killed while {kind} are written"
        count = max(round(share * kills), 1)
        cases.append(Case(fault, f"{fault}, {workers} workers", Preparation(kind, workers, count)))
    return cases
