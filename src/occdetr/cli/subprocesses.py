"""Run other entry points, each in a process and an output folder of its own."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from occdetr import use_all_cores
from occdetr.cli.folders import remove_former_run


@dataclass(frozen=True)
class FinishedRun:
    """An entry point that ended successfully: its command line, and its duration in seconds."""

    command: str
    seconds: float


def run_entry_point(
    entry: str,
    overrides: Sequence[str],
    folder: Path,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> FinishedRun:
    """Run ``python -m occdetr.<entry> <overrides>`` with ``folder`` as its output folder.

    ``environment``: variables that it gets unless this process has them. A former run there is
    removed first. If the entry point fails, this process ends with the same exit code; the reason
    has been printed by the entry point.

    Raises ``InputError`` if the folder holds anything else than a former run of ``entry``.
    """
    remove_former_run(folder, entry)
    arguments = ["-m", f"occdetr.{entry}", *overrides, f"hydra.run.dir={folder}"]
    command = shlex.join(["python", *arguments])
    print(f"\n== {folder.name}: {command}", flush=True)
    use_all_cores()  # which the new process inherits
    start = time.monotonic()
    variables = {**environment, **os.environ}
    exit_code = subprocess.run([sys.executable, *arguments], env=variables, check=False).returncode
    if exit_code:
        sys.exit(exit_code)
    return FinishedRun(command, round(time.monotonic() - start, 1))
