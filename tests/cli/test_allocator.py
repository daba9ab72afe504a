"""Keeping freed memory."""

import ctypes
import os
import subprocess
import sys

import pytest

from occdetr.cli import allocator
from occdetr.cli.allocator import keep_freed_memory

MAPPED = """
import resource
from occdetr.cli.allocator import keep_freed_memory
import numpy as np
kept = keep_freed_memory()
np.ones(1 << 24)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
np.ones(1 << 24)
print(int(kept), resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="another C library")
def test_a_freed_block_is_used_again():
    """Two blocks of 128 MiB in turn: the second needs no pages from the system."""
    without = {key: value for key, value in os.environ.items() if not key.startswith("MALLOC_")}
    for more, kept in (({}, "1"), ({"MALLOC_TRIM_THRESHOLD_": "131072"}, "0")):
        run = [sys.executable, "-c", MAPPED]
        output = subprocess.check_output(run, env={**without, **more}, text=True)
        switched, faults = output.split()
        assert switched == kept
        assert (int(faults) < 10) == (kept == "1")


def test_another_c_library_is_left_alone(monkeypatch):
    for name in [name for name in os.environ if name.startswith("MALLOC_")]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(allocator.ctypes, "CDLL", lambda name: object())
    assert not keep_freed_memory()
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_freed_memory()
