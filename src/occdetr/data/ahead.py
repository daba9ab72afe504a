"""Steps that run beside each other, in threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T, R = TypeVar("T"), TypeVar("R")


def map_ahead(function: Callable[[T], R], items: Iterable[T], threads: int = 1) -> Iterator[R]:
    """``map(function, items)`` in threads, in order, while the caller does other work.

    At most ``threads`` + 1 results are computed or wait beside the one that the caller has.
    ``items`` is iterated in the caller's thread. An error of ``function`` is raised in place of its
    result. After an error, or when the iterator is closed, the calls for items that were already
    taken are finished first.
    """
    pool = ThreadPoolExecutor(threads)
    ahead: deque[Future[R]] = deque()
    try:
        for item in items:
            ahead.append(pool.submit(function, item))
            if len(ahead) > threads + 1:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        pool.shutdown()
