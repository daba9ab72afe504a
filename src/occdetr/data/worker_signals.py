"""Signals to a whole process group, in the workers of a loader."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from types import FrameType

#: With these, clusters announce an end, to all processes of a job at once.
ANNOUNCING = (signal.SIGUSR1, signal.SIGUSR2)


def leave_signals_to_parent() -> None:
    """Go on loading when SIGTERM, SIGUSR1 or SIGUSR2 reaches this worker too.

    ``timeout``, shells and clusters signal all processes of a run. The main process then ends its
    step, writes a checkpoint and stops the workers; without them the step would fail. SIGTERM from
    the main process itself, by which PyTorch stops a worker, ends this one. Nothing is changed on
    macOS, which does not tell who sends a signal.
    """
    if not hasattr(signal, "sigwaitinfo"):
        return
    for number in ANNOUNCING:
        signal.signal(number, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    signal.signal(signal.SIGTERM, _nothing)  # in a thread that does not block it
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    threading.Thread(target=_wait_for, args=(parent.pid,), daemon=True).start()


def _nothing(number: int, frame: FrameType | None) -> None:
    pass


def _wait_for(parent: int | None) -> None:
    """Exit at a SIGTERM that ``parent`` sends."""
    while signal.sigwaitinfo({signal.SIGTERM}).si_pid != parent:
        pass
    os._exit(0)
