"""Annotated shapes and types are checked while the tests run, and only then."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # small arrays: threads cost more than they give

import pytest
import torch
from jaxtyping import install_import_hook

install_import_hook("occdetr", "shape_checks.check_types")

pytest_plugins = ["shared_runs"]  # imported after the hook: it imports occdetr


@pytest.fixture(autouse=True)
def denormals():
    """Programs that ran in this process have made denormals zero, which Hypothesis refuses."""
    torch.set_flush_denormal(False)
    yield
    torch.set_flush_denormal(False)
