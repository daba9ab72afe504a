"""Where the time of a computation goes."""

from __future__ import annotations

import time


class Stopwatch:
    """Seconds of the named parts of a computation.

    It starts when it is made; each ``lap`` adds the time since the lap before to a part.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, part: str) -> None:
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self._last
        self._last = now
