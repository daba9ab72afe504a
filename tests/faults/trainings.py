"""Trainings that are killed, stopped by signals, or find their checkpoint damaged."""

from __future__ import annotations

import itertools
import random
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from faults.bench import PATIENCE, Bench, Training, checkpoints, outcome
from faults.cases import Case, Lost, Report, note_remains
from faults.moments import AtRenaming, WhileWriting
from faults.processes import Run, stop, wait_all
from occdetr.training.run_checkpoint import LAST, PREVIOUS
from occdetr.training.stop_signals import STOPPED

#: Random moments are drawn from this share of the time of an undisturbed run, so that a run is
#: killed a few times before it ends.
HORIZON = 0.6

#: Waits for the moment and strikes; whether the run was hit, or had ended before.
Strike = Callable[[list[Run], random.Random, float], bool]
#: Draws what is called in the process before the entry point.
Before = Callable[[random.Random], Callable[[], object] | None]


@dataclass(frozen=True)
class Chain:
    """A training that is hit ``count`` times and continued each time; once it has ended, another.

    Its end is compared with that of the undisturbed run. ``before`` and ``strike`` inject the
    fault; ``after`` is what happens to the checkpoints between two runs, and whether it counts.
    Where something happened to them, a run has to warn of it by the words ``warning``.
    """

    training: Training
    count: int
    strike: Strike
    before: Before = lambda generator: None
    after: Callable[[Path, random.Random], bool] = lambda place, generator: True
    warning: str = ""

    def __call__(self, bench: Bench, generator: random.Random, place: Path, report: Report) -> None:
        reference = bench.reference(self.training)
        for number in itertools.count():
            if report.injected >= self.count or report.lost:
                return
            task, runs, before = place / f"{number}", [], report.injected
            while self._goes_on(bench, generator, task, runs, report):
                pass
            if not report.lost:
                changed = reference.differences(outcome(task))
                report.lost += [f"{task}: {text} differ" for text in changed]
                warned = any(self.warning in run.err.read_text() for run in runs)
                if report.injected > before and not warned:
                    report.lost.append(f"{task}: no run said {self.warning!r}")
            note_remains(runs, task, report)

    def _goes_on(
        self,
        bench: Bench,
        generator: random.Random,
        task: Path,
        runs: list[Run],
        report: Report,
    ) -> bool:
        """Start or continue the task; whether it is to be continued."""
        hits = report.injected < self.count
        before = self.before(generator) if hits else None
        ranks = bench.start(self.training, task, f"{len(runs):03d}", before)
        runs += ranks
        # later and later, so that a machine that has become slower gets to the next checkpoint
        seconds = bench.reference(self.training).seconds * (1 + len(runs) / 10)
        if hits and self.strike(ranks, generator, seconds):
            report.injected += self.after(task, generator)
            return True
        codes = wait_all(ranks, PATIENCE)
        if not any(codes) or _had_finished(task, ranks):
            return False
        last = ranks[0].err.read_text().strip().splitlines()[-1:]
        report.lost.append(f"{ranks[0].err}: it ended with {codes}: {last}")
        return False


def _had_finished(task: Path, ranks: list[Run]) -> bool:
    """Whether the run was killed behind its end, and says so when it is continued."""
    finished = (checkpoints(task)[-1].parent / "metrics.json").is_file()
    return finished and all("has finished" in run.err.read_text() for run in ranks)


def kill_at_random(ranks: list[Run], generator: random.Random, seconds: float) -> bool:
    """SIGKILL to all ranks, or to one of several, whose launcher then stops the others."""
    victim = generator.choice(ranks)
    everyone = generator.random() < 0.5
    victim.wait(generator.uniform(0, HORIZON * seconds))
    if any(run.code is not None for run in ranks):
        return False
    victim.kill()
    stop(ranks, signal.SIGKILL if everyone else signal.SIGTERM)
    return victim.code == -signal.SIGKILL


def signal_at_random(ranks: list[Run], generator: random.Random, seconds: float) -> bool:
    """SIGTERM or SIGUSR1 to all ranks, as a cluster that needs the machine sends it.

    A run that has begun to train writes a checkpoint and ends with a code of its own; one that has
    not begun is killed by the signal.
    """
    number = generator.choice([signal.SIGTERM, signal.SIGUSR1])
    ranks[0].wait(generator.uniform(0, HORIZON * seconds))
    if any(run.code is not None for run in ranks):
        return False
    for run in ranks:
        run.kill(number)
    codes = wait_all(ranks, PATIENCE)
    if not set(codes) <= {0, STOPPED, -number}:
        raise Lost(f"{ranks[0].err}: after {number.name} it ended with {codes}")
    return any(codes)


def ends_by_itself(ranks: list[Run], generator: random.Random, seconds: float) -> bool:
    """The moment is chosen inside the process."""
    return any(wait_all(ranks, PATIENCE))


def while_writing(generator: random.Random) -> Callable[[], object]:
    """In the midst of the writing of a checkpoint, or just before it gets its name."""
    count = generator.randint(1, 8)
    if generator.random() < 0.5:
        return AtRenaming(count, ".ckpt")
    return WhileWriting(count, ".ckpt", generator.uniform(0.1, 0.95))


def damage_last(task: Path, generator: random.Random) -> bool:
    """Cut short the newest checkpoint, empty it, or change some of its bytes.

    Only where there is one before it; whether there was.
    """
    found = checkpoints(task)
    if not found or not found[-1].with_name(PREVIOUS).is_file():
        return False
    content = bytearray(found[-1].read_bytes())
    if not content:  # damaged before, and not replaced since
        return False
    way = generator.choice(["cut", "empty", "bytes"])
    if way == "bytes":
        for _ in range(20):
            content[generator.randrange(len(content))] ^= generator.randint(1, 255)
    else:
        del content[0 if way == "empty" else generator.randrange(len(content)) :]
    found[-1].write_bytes(content)
    return True


def training_cases(kills: int = 100) -> list[Case]:
    """Cases with about four fifths of ``kills`` kills, and signals and damages beside them."""
    cases = []

    def add(fault: str, training: Training, share: float, strike: Strike, **ways: object) -> None:
        left = max(round(share * kills), 1)
        for number in itertools.count():
            count = min(left, 5)
            chain = Chain(training, count, strike, **ways)  # type: ignore[arg-type]
            cases.append(Case(fault, f"{fault}, {training.name}, {number}", chain))
            left -= count
            if left <= 0:
                return

    random_kill = "SIGKILL at a random moment"
    writing = "killed while a checkpoint is written"
    stopped, damaged = "SIGTERM or SIGUSR1", "the last checkpoint damaged"
    for stage in ("pretrain", "full"):
        for workers, share in ((0, 0.05), (1, 0.05), (2, 0.05)):
            add(random_kill, Training(stage, 1, workers), share, kill_at_random)
        add(random_kill, Training(stage, 2, 1), 0.1, kill_at_random)
        for ranks in (1, 2):
            training = Training(stage, ranks)
            add(writing, training, 0.05, ends_by_itself, before=while_writing)
            add(stopped, training, 0.04, signal_at_random)
        training = Training(stage, 1, 1)
        add(damaged, training, 0.05, kill_at_random, after=damage_last, warning=LAST)
    return cases
