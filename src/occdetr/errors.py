"""The exception for errors that the user can fix, and checks of numbers that raise it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


class InputError(ValueError):
    """Invalid input: a file, a folder or a setting.

    Its message is one line that names the file or setting and says what to do. Entry points print
    it without a traceback and exit with code 2.
    """


class NonFiniteError(InputError):
    """A result is not finite. All ranks of a run raise it together, and the first reports it."""


@dataclass(frozen=True)
class Range:
    """Finite numbers from ``least`` to ``most``; ``open``: those ends themselves are outside."""

    least: float = -math.inf
    most: float = math.inf
    open_least: bool = False
    open_most: bool = False

    def __contains__(self, value: float) -> bool:
        """False for NaN too."""
        above = self.least < value if self.open_least else self.least <= value
        below = value < self.most if self.open_most else value <= self.most
        return above and below and math.isfinite(value)

    def __str__(self) -> str:
        if self.least == -math.inf:
            return "a finite number"
        if self.most == math.inf:
            return f"more than {self.least}" if self.open_least else f"{self.least} or more"
        least = f"above {self.least}" if self.open_least else f"{self.least}"
        return f"{least} to {'below ' if self.open_most else ''}{self.most}"


COUNT = Range(1)
NOT_NEGATIVE = Range(0)
POSITIVE = Range(0, open_least=True)
SHARE = Range(0, 1)
BELOW_ONE = Range(0, 1, open_most=True)
# far beyond all use; more would fill the memory or start processes without end
LAYERS = Range(1, 100)
CHANNELS = Range(1, 2**14)
BATCH = Range(1, 2**14)
PROCESSES = Range(0, 1024)
SEED = Range(0, 2**32 - 1)  # NumPy's


def check_range(setting: str, value: float | None, limits: Range) -> None:
    """Raises ``InputError`` if ``value`` is outside of ``limits``; None, where allowed, is not."""
    if value is not None and value not in limits:
        raise InputError(f"{setting}={value}: give {limits}")


def check_ranges(node: str, owner: Any, **limits: Range) -> None:
    """``check_range`` of attributes of ``owner``, which are settings of ``node``."""
    for name, each in limits.items():
        check_range(f"{node}.{name}", getattr(owner, name), each)


def check_each(setting: str, values: Any, limits: Range) -> None:
    """``check_range`` of every number of a list, or of a dictionary by name."""
    if isinstance(values, dict):
        for name, value in values.items():
            check_range(f"{setting}.{name}", value, limits)
    elif any(value not in limits for value in values):
        raise InputError(f"{setting}={list(values)}: give numbers of {limits}")
