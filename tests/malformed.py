"""A generator of malformed inputs: pictures, calibrations, voxel files and folders of data sets.

Each case writes its files and names the entry point that must refuse them: in one line for each
error on stderr, with one of the case's exit codes, without a traceback and with nothing half
written.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Malformed:
    """One malformed input.

    ``make`` writes its files below a folder and returns the overrides for the entry point
    ``command``, which must end with one of ``codes``. ``kind`` groups the cases in tables.
    """

    name: str
    kind: str
    command: str
    make: Callable[[Path], list[str]]
    codes: tuple[int, ...] = (2,)


def malformed_inputs() -> list[Malformed]:
    """Every case; the names differ."""
    return []
