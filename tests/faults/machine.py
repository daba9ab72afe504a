"""Faults of the machine: a full disk, too little shared memory, processes that are killed."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import random
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from faults.bench import PATIENCE, Bench, Training, contents, outcome
from faults.cases import Case, Lost, Report, check_user_error, note_remains
from faults.moments import limit_files
from faults.processes import Run, start, wait_all
from faults.trainings import HORIZON, Chain

CLONE_NEWNS = 0x00020000  # unshare(2): mounts of its own


@dataclass(frozen=True)
class FullDisk:
    """A training on a file system that gets full, and is continued when there is room again.

    Without the right to mount one, files that cannot grow beyond a size.
    """

    stage: str

    def __call__(self, bench: Bench, generator: random.Random, place: Path, report: Report) -> None:
        training = Training(self.stage)
        reference = bench.reference(training)
        kib = generator.randint(200, 4500)
        with contextlib.ExitStack() as stack:
            disk, before = place / "outputs", None
            if can_mount():
                stack.enter_context(small_disk(disk, kib))
            else:
                before = functools.partial(limit_files, 1024 * kib // 5)
            ranks = bench.start(training, place, "full", before)
            (code,) = wait_all(ranks, PATIENCE)
            if code != 0:  # else all fitted
                check_user_error(ranks[0], (2,), *(["disk"] if can_mount() else []))
                report.injected += 1
                if can_mount():
                    resize(disk, 2**16)
                ranks += bench.start(training, place, "continued")
                if wait_all(ranks[1:], PATIENCE) != [0]:
                    raise Lost(f"{ranks[1].err}: it did not go on")
            report.lost += [f"{text} differ" for text in reference.differences(outcome(place))]
            note_remains(ranks, place, report)


@dataclass(frozen=True)
class FullDiskOfLabels:
    """``prepare`` on a file system that gets full, and again when there is room."""

    kind: str

    def __call__(self, bench: Bench, generator: random.Random, place: Path, report: Report) -> None:
        wanted, _ = bench.prepared(self.kind)
        size = sum(map(len, wanted.values())) // 1024
        with small_disk(place / self.kind, generator.randint(size // 8, size // 2)) as disk:
            given = [*bench.preparation(self.kind, disk, 1), f"outputs={place}"]
            full = start("prepare", given, place / "logs" / "full")
            full.wait(PATIENCE)
            check_user_error(full, (2,), "disk")
            report.injected += 1
            resize(disk, 4 * size + 2**16)
            again = start("prepare", given, place / "logs" / "again")
            if again.wait(PATIENCE) != 0:
                raise Lost(f"{again.err}: it did not go on")
            if contents(disk) != wanted:
                raise Lost(f"{disk}: the files differ")
            note_remains([full, again], place, report)


@contextlib.contextmanager
def small_disk(folder: Path, kib: int) -> Iterator[Path]:
    """Mount a file system of ``kib`` KiB, which lies in memory."""
    folder.mkdir(parents=True)
    given = ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "none", str(folder)]
    subprocess.run(given, check=True, capture_output=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@functools.cache
def can_mount() -> bool:
    """Root can, but not in every container."""
    try:
        with tempfile.TemporaryDirectory() as folder, small_disk(Path(folder) / "disk", 64):
            return True
    except (subprocess.CalledProcessError, FileNotFoundError):
        return False


def resize(folder: Path, kib: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={kib}k", str(folder)], check=True)


def little_shared_memory() -> None:
    """Give this process and its workers a ``/dev/shm`` of 64 KiB, less than a batch."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(CLONE_NEWNS):
        raise OSError(ctypes.get_errno(), "unshare")
    subprocess.run(["mount", "--make-rprivate", "/"], check=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", "/dev/shm"], check=True)


def too_little_shared_memory(
    bench: Bench, generator: random.Random, place: Path, report: Report
) -> None:
    training = Training("pretrain", 1, generator.randint(1, 2))
    ranks = bench.start(training, place, "run", little_shared_memory)
    wait_all(ranks, 60.0)
    check_user_error(ranks[0], (2,))
    report.injected += 1
    note_remains(ranks, place, report)


def kill_loader_worker(ranks: list[Run], generator: random.Random, seconds: float) -> bool:
    """SIGKILL to a worker of a training, which must end with one line."""
    run = ranks[0]
    run.wait(generator.uniform(0.4, HORIZON) * seconds)
    workers = run.children()
    if not workers or run.code is not None:
        return False
    os.kill(generator.choice(workers), signal.SIGKILL)
    if run.wait(60.0) is None:
        run.kill()
        raise Lost(f"{run.err}: it hangs for 60 s after one of its workers was killed")
    if run.code == 0:
        return False  # it had all its batches
    check_user_error(run, (2,))
    return True


@dataclass(frozen=True)
class KillPreparingWorker:
    """SIGKILL to one of the processes that make "labels" or "streets"."""

    kind: str

    def __call__(self, bench: Bench, generator: random.Random, place: Path, report: Report) -> None:
        wanted, _ = bench.prepared(self.kind)
        given = [*bench.preparation(self.kind, place / self.kind, 2), f"outputs={place}"]
        run = start("prepare", given, place / "logs" / "run")
        while run.code is None and not (workers := preparing(run)):
            run.wait(0.05)
        if run.code is None:
            os.kill(generator.choice(workers), signal.SIGKILL)
            if run.wait(60.0) is None:
                raise Lost(f"{run.err}: it hangs for 60 s after one of its workers was killed")
            check_user_error(run, (2,))
            report.injected += 1
        again = start("prepare", given, place / "logs" / "again")
        if again.wait(PATIENCE) != 0 or contents(place / self.kind) != wanted:
            raise Lost(f"{again.err}: it did not go on, or the {self.kind} differ")
        note_remains([run, again], place, report)


def preparing(run: Run) -> list[int]:
    """Its workers: spawned processes, but for the tracker of shared resources."""
    found = []
    for pid in run.children():
        with contextlib.suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


def machine_cases(times: int = 4) -> list[Case]:
    cases = []
    for number in range(times):
        for stage in ("pretrain", "full"):
            fault = "disk full in training"
            cases.append(Case(fault, f"{fault}, stage={stage}, {number}", FullDisk(stage)))
        for kind in ("labels", "streets") if can_mount() else ():
            fault = f"disk full while {kind} are written"
            cases.append(Case(fault, f"{fault}, {number}", FullDiskOfLabels(kind)))
        for kind in ("labels", "streets"):
            fault = f"a process that makes {kind} killed"
            cases.append(Case(fault, f"{fault}, {number}", KillPreparingWorker(kind)))
    if can_mount():
        fault = "too little shared memory"
        cases.append(Case(fault, fault, too_little_shared_memory))
    fault = "a loader worker killed"
    for stage in ("pretrain", "full"):
        training = Training(stage, 1, 2)
        name = f"{fault}, {training.name}"
        cases.append(Case(fault, name, Chain(training, times, kill_loader_worker)))
    return cases
