"""Time measurement of the steps of a computation."""

from __future__ import annotations

import time


class Stopwatch:
    """The seconds of named steps, measured from its construction.

    Each ``lap`` adds the time since the previous lap to a step.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        now = time.perf_counter()
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self._last
        self._last = now
