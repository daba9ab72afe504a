"""Entry points in processes that are forked from one that has imported the package.

A start then takes half a second instead of ten. The process that is forked, that of
``multiprocessing``'s fork server, has a single thread and has computed nothing. Linux only.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path

ENTRIES = ("train", "prepare", "evaluate", "predict", "visualize", "benchmark", "survey")
LIBRARIES = ("lightning.pytorch", "torch.utils.tensorboard", "faster_coco_eval")
OWN = ("faults.processes", "faults.moments", "faults.machine", "faults.small_backbone")
#: Seconds that a launcher gives the other ranks when one has failed (torchrun: 30).
GRACE = 15.0

_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(
    [*LIBRARIES, *OWN, *(f"occdetr.{entry}" for entry in ENTRIES)]  # what is missing is left out
)


@dataclass
class Run:
    """An entry point at work, in a session of its own; what it prints goes to ``out``, ``err``."""

    process: BaseProcess
    out: Path
    err: Path

    @property
    def code(self) -> int | None:
        """The exit code, or minus the signal that ended it; None while it runs."""
        return self.process.exitcode

    def wait(self, seconds: float | None = None) -> int | None:
        self.process.join(seconds)
        return self.code

    def kill(self, number: int = signal.SIGKILL) -> None:
        """Send a signal to the main process alone, as the kernel does that is out of memory."""
        assert self.process.pid
        if self.code is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.process.pid, number)

    def children(self) -> list[int]:
        """Its further processes, such as loader workers; also after it has ended."""
        own = self.process.pid
        return [pid for pid, session in _sessions() if session == own and pid != own]

    def orphans(self, patience: float = 20.0) -> int:
        """How many of them have not ended ``patience`` seconds after it. They are ended."""
        end = time.monotonic() + patience
        while (left := self.children()) and time.monotonic() < end:
            time.sleep(0.02)
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return len(left)


def start(
    entry: str,
    overrides: Sequence[object],
    log: Path,
    environment: Mapping[str, str] | None = None,
    before: Callable[[], object] | None = None,
) -> Run:
    """Start ``python -m occdetr.<entry> <overrides>``.

    ``log`` is the stem of its two log files, and their folder its working directory. ``before``, a
    function of a module, is called in the process before the entry point.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    out, err = Path(f"{log}.out"), Path(f"{log}.err")
    method = multiprocessing.get_start_method()  # of loader workers; not this process's own
    texts = [str(text) for text in overrides]
    arguments = (method, entry, texts, out, err, environment, before)
    process = _FORKS.Process(target=_main, args=arguments)
    process.start()
    return Run(process, out, err)


def start_ranks(
    count: int,
    overrides: Sequence[object],
    log: Path,
    before: Callable[[], object] | None = None,
) -> list[Run]:
    """Start ``count`` ranks of a training as torchrun does; a single one without its variables."""
    if count == 1:
        return [start("train", overrides, log, before=before)]
    port = str(_free_port())
    shared = {
        **{"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": str(count)},
        **{"LOCAL_WORLD_SIZE": str(count), "GROUP_RANK": "0", "TORCHELASTIC_RUN_ID": port},
    }
    return [
        start(
            "train",
            overrides,
            log.with_name(f"{log.name}-rank{rank}"),
            {**shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            before,
        )
        for rank in range(count)
    ]


def wait_all(ranks: Sequence[Run], seconds: float) -> list[int | None]:
    """The exit codes of all ranks; None for one that had to be killed.

    As a launcher does, it stops the others as soon as one has failed, and all when the time is
    over.
    """
    end = time.monotonic() + seconds
    while any(run.code is None for run in ranks):
        if time.monotonic() > end:
            return stop(ranks)
        if any(run.code for run in ranks):  # ended, and not with 0
            return stop(ranks, signal.SIGTERM)
        time.sleep(0.01)
    return [run.code for run in ranks]


def stop(ranks: Sequence[Run], number: int = signal.SIGKILL) -> list[int | None]:
    """Send all ranks a signal, and SIGKILL to those that still run after ``GRACE``."""
    for run in ranks:
        run.kill(number)
    end = time.monotonic() + GRACE
    codes = [run.wait(max(end - time.monotonic(), 0)) for run in ranks]
    for run in ranks:
        run.kill()
        run.wait()
    return codes


def _main(
    method: str,
    entry: str,
    overrides: list[str],
    out: Path,
    err: Path,
    environment: Mapping[str, str] | None,
    before: Callable[[], object] | None,
) -> None:
    os.setsid()
    multiprocessing.set_start_method(method, force=True)
    for path, stream in ((out, sys.stdout), (err, sys.stderr)):
        with path.open("ab") as file:
            os.dup2(file.fileno(), stream.fileno())
    os.chdir(out.parent)
    os.environ.update(environment or {})
    sys.argv = [f"{entry}.py", *overrides]
    if before is not None:
        before()
    importlib.import_module(f"occdetr.{entry}").main()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def _sessions() -> Iterator[tuple[int, int]]:
    """(process, session) of every process that has not ended."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, _, session = path.read_text().rpartition(")")[2].split()[:4]
            if state not in "ZX":
                yield int(path.parent.name), int(session)
