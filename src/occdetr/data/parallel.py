"""Calls in parallel processes, which end with the one that started them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from typing import TypeVar

from occdetr.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_processes(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int,
    start: Callable[[], None] | None = None,
) -> Iterator[Result]:
    """``function`` of each item, in order, computed by ``workers`` spawned processes, each of which
    first calls ``start``.

    On Ctrl-C they finish their items; when this process is killed they end at once. Raises
    ``InputError`` if one of them was killed.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_start, initargs=(start,)) as pool:
        try:
            with _interrupts_blocked():
                futures = [pool.submit(function, item) for item in items]
            for future in futures:
                yield future.result()
        except BrokenProcessPool:
            raise InputError(
                f"one of {workers} processes was killed, possibly for lack of memory: "
                "run it again with fewer workers; finished files are kept"
            ) from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Delay SIGINT in this process, and block it for good in processes started meanwhile, which
    inherit the mask: on Ctrl-C they finish their items, and the parent stops."""
    resource_tracker.ensure_running()  # starting it later would clear the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start(further: Callable[[], None] | None) -> None:
    """Exit when the parent process was killed: workers would wait for jobs forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    if further is not None:
        further()
