"""What processes may use of this machine: cores, and the memory that they share."""

from __future__ import annotations

import math
import os
from pathlib import Path

from occdetr import CORES
from occdetr.errors import InputError

CGROUP = Path("/sys/fs/cgroup")
SHARED_MEMORY = Path("/dev/shm")
MIB = 2**20


def available_cores() -> int:
    """The cores that this process may use: of its affinity, and of its container's CPU quota."""
    cores = len(CORES) if CORES else os.cpu_count() or 1
    return max(1, math.ceil(min(cores, _quota())))


def _quota() -> float:
    """Cores of the control group's quota (version 2 or 1); infinite without one."""
    for files in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            words = " ".join((CGROUP / file).read_text(encoding="ascii") for file in files).split()
            quota, period = float(words[0]), float(words[1])
        except (OSError, ValueError, IndexError):  # no such file, or "max"
            continue
        if quota > 0 and period > 0:
            return quota / period
    return math.inf


def check_shared_memory(needed: int, setting: str) -> None:
    """Raises ``InputError`` if worker processes cannot share ``needed`` bytes with this one.

    Without this check the system kills the worker that writes too much, and the others wait.
    """
    try:
        state = os.statvfs(SHARED_MEMORY)
    except OSError:  # another system
        return
    free = state.f_bavail * state.f_frsize
    if free < needed:
        raise InputError(
            f"{setting}: its processes need about {math.ceil(needed / MIB)} MiB of shared memory, "
            f"{SHARED_MEMORY} has {free // MIB} free: set {setting.partition('=')[0]}=0 or lower "
            "data.batch_size, or enlarge it (docker run --shm-size=8g)"
        )
