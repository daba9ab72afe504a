"""Moments inside a run at which it is killed: chosen by counting, so that they can be repeated.

Each is a value that is called in the process before the entry point.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
from dataclasses import dataclass
from typing import Any


@dataclass
class AtRenaming:
    """SIGKILL just before file number ``count`` (from 1) gets its name, whole as it is.

    Only files are counted whose name ends with ``suffix``. Python reports every renaming to audit
    hooks before it happens.
    """

    count: int
    suffix: str = ""

    def __call__(self) -> None:
        sys.addaudithook(self._on_event)

    def _on_event(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "os.rename" and str(arguments[1]).endswith(self.suffix):
            self.count -= 1
            if self.count == 0:
                self.strike(str(arguments[0]))

    def strike(self, file: str) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


@dataclass
class WhileWriting(AtRenaming):
    """Ended by the kernel in the midst of writing the file that follows file number ``count``, when
    it has ``share`` of the size of that one.

    The kernel does so with SIGXFSZ, which cannot be delayed either, where a file exceeds a limit.
    """

    share: float = 0.5

    def strike(self, file: str) -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # Python ignores it
        limit_files(int(os.path.getsize(file) * self.share))


def limit_files(size: int) -> None:
    """Let no file of this process grow beyond ``size`` bytes."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
