"""The C library's allocator, set to keep what is freed."""

from __future__ import annotations

import ctypes
import os
import sys

#: Parameters of glibc's ``mallopt`` (malloc.h), and values that mean "never".
TRIM_THRESHOLD, MMAP_MAX = -1, -4
NEVER_TRIM, NO_MAPPINGS = -1, 0


def keep_freed_memory() -> bool:
    """Let glibc reuse large blocks; whether it does now.

    By default it maps every block above 32 MiB (at first 128 KiB) from the system and gives it
    back when freed. The system clears each page of the next one, which took 6 % of the steps of a
    pretraining on a CPU (docs/performance.md). Elsewhere than with glibc it does nothing, nor if a
    variable ``MALLOC_...`` of glibc's is set: MALLOC_TRIM_THRESHOLD_=131072 keeps the default.
    """
    own = any(name.startswith("MALLOC_") for name in os.environ)
    if own or not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    return bool(mallopt(MMAP_MAX, NO_MAPPINGS) and mallopt(TRIM_THRESHOLD, NEVER_TRIM))
