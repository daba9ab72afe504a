"""Where a result comes from: the state of the code, the machine, hashes of files."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from occdetr.data.processes import available_cores

#: The paths of the repository that results depend on.
CODE = ("src", "conf", "pyproject.toml", "constraints.txt")


def code_state(repository: Path) -> dict[str, Any]:
    """``commit``, and ``dirty``: whether code or configuration have uncommitted changes.

    Both are None outside a repository.
    """
    commit = _git(repository, "rev-parse", "HEAD") if (repository / ".git").exists() else None
    if commit is None:
        return {"commit": None, "dirty": None}
    return {"commit": commit, "dirty": bool(_git(repository, "status", "--porcelain", "--", *CODE))}


def code_hash(*folders: Path) -> str:
    """Hash of the names and contents of all Python and YAML files in ``folders``, 12 digits."""
    total = hashlib.sha256()
    for folder in folders:
        for file in sorted(file for end in ("py", "yaml") for file in folder.rglob(f"*.{end}")):
            total.update(f"{file.relative_to(folder)} {file_hash(file)}\n".encode())
    return total.hexdigest()[:12]


def _git(repository: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(repository), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:  # git is not installed
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def machine(device: torch.device, precision: Any) -> dict[str, Any]:
    """The machine and precision of a measurement, as a record keeps them."""
    return {
        "cpu": _cpu_name(),
        "cores": available_cores(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "torch": torch.__version__,
        "precision": str(precision),
    }


def _cpu_name() -> str:
    """The name in /proc/cpuinfo on Linux, else the one that Python reports."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
