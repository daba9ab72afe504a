"""Numbers that are too small for a float's exponent."""

import subprocess
import sys

import pytest
import torch

from programs import program

IN_ALL_THREADS = """
import torch
from occdetr.cli.denormals import flush_denormals
torch.set_num_threads(2)
flushed = flush_denormals()
print(int(flushed), (torch.full((4_000_000,), 1e-39) * 0.5).count_nonzero().item())
"""


HAS_SWITCH = torch.set_flush_denormal(False)


@pytest.mark.skipif(not HAS_SWITCH, reason="another processor")
def test_they_are_zero_in_all_threads():
    assert subprocess.check_output([sys.executable, "-c", IN_ALL_THREADS], text=True) == "1 0\n"


@pytest.mark.skipif(not HAS_SWITCH, reason="another processor")
def test_every_program_flushes_them(capsys):
    assert (torch.tensor([1e-39]) * 0.5).item() > 0
    assert program("evaluate", "checkpoint=none.ckpt") == 2
    assert (torch.tensor([1e-39]) * 0.5).item() == 0
