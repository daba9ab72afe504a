"""Annotated shapes and types are checked while the tests run, and only then."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # small arrays: threads cost more than they give

from jaxtyping import install_import_hook

install_import_hook("occdetr", "shape_checks.check_types")

pytest_plugins = ["shared_runs"]  # imported after the hook: it imports occdetr
