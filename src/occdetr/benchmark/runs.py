"""``part=all``: every table of docs/performance.md, each in a process of its own."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from occdetr.benchmark.peer import check_peer
from occdetr.cli.subprocesses import run_entry_point
from occdetr.errors import InputError

#: Without these a time on the CPU can be several times too long: pages that are returned to the
#: system and fetched anew, and two threads on one core. They are read when a process starts.
ENVIRONMENT = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "100000000000",
    "OMP_PROC_BIND": "close",
}


def run_all(config: DictConfig, folder: Path) -> str:
    """Run the benchmark with the settings of each of ``config.runs``, then those of this command
    line, in a folder of that name. ``compile`` is for runs with ``vs``. Returns all tables as
    Markdown.

    Raises ``InputError`` if there are no runs, or a package is missing that one of them needs.
    """
    if not isinstance(config.runs, DictConfig):
        raise InputError(f"runs={config.runs}: give the settings of each run by its name")
    runs = {str(name): list(settings) for name, settings in config.runs.items()}
    if any("vs=transformers" in settings for settings in runs.values()):
        check_peer()
    given = HydraConfig.get().overrides.task
    own = [text for text in given if not text.startswith(("part=", "runs", "outputs="))]
    texts = []
    for name, settings in runs.items():
        beside = any(text.startswith("vs=") for text in settings)
        fitting = [text for text in own if beside or not text.startswith("compile=")]
        run_entry_point("benchmark", [*settings, *fitting], folder / name, ENVIRONMENT)
        texts.append((folder / name / "benchmark.md").read_text(encoding="utf-8"))
    return "\n".join(texts)
