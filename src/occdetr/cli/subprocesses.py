"""Entry points run one after the other, each in a process and a folder of its own."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Command:
    """An entry point that has ended well: the line that repeats it, and how long it took."""

    line: str
    seconds: float


def run_entry(entry: str, overrides: Sequence[str], folder: Path) -> Command:
    """Run ``python -m occdetr.<entry> <overrides>`` with ``folder``, emptied before, for its files.

    If it fails, this process ends with the same exit code: the entry point has said why.
    """
    shutil.rmtree(folder, ignore_errors=True)
    arguments = ["-m", f"occdetr.{entry}", *overrides, f"hydra.run.dir={folder}"]
    line = shlex.join(["python", *arguments])
    print(f"\n== {folder.name}: {line}", flush=True)
    began = time.monotonic()
    code = subprocess.run([sys.executable, *arguments], check=False).returncode
    if code:
        sys.exit(code)
    return Command(line, round(time.monotonic() - began, 1))
