"""Size and speed of a network or of the data loaders: ``python -m occdetr.benchmark``.

``part=model model=...`` measures the network by parts; with ``mode=train stage=...`` a training
step by phases; with ``vs=transformers`` the network beside a detector of another project.
``part=scaling`` shows how the cost grows with the work, ``part=loader data=... data.root=...`` how
fast the loaders are, and ``part=all`` makes every table of docs/performance.md.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console

from occdetr.benchmark.growth import measure_growth
from occdetr.benchmark.loaders import measure_loaders
from occdetr.benchmark.network import measure_network
from occdetr.benchmark.peer import compare
from occdetr.benchmark.runs import run_all
from occdetr.benchmark.sheet import Sheet
from occdetr.benchmark.step import measure_step
from occdetr.cli import entry as cli
from occdetr.errors import InputError
from occdetr.files import write_atomically, write_json
from occdetr.training.trainer import seed_everything

#: Settings of the trainer in whose place ``mode=train`` takes one of its own.
OWN_SETTINGS = {
    **{"precision": "precision", "accelerator": "device", "devices": "device"},
    **dict.fromkeys(("max_epochs", "max_steps", "limit_train_batches"), "repeats"),
}


@cli.entry_point("benchmark")
def main(config: DictConfig) -> None:
    """Measure, print a table, write ``benchmark.json`` and ``benchmark.md`` into the run's folder.

    ``part=all`` writes the tables of its runs into ``benchmark.md``.
    """
    parts = {"model": measure_model, "scaling": measure_growth, "loader": measure_loaders}
    choose("part", config.part, [*parts, "all"])
    check_effect(config)
    check_trainer_settings(HydraConfig.get().overrides.task)
    seed_everything(config.seed)
    folder = cli.run_folder()
    if config.part == "all":
        document = run_all(config, folder)
        print(f"\n{document}")
    else:
        report, sheet = parts[config.part](config)
        document = sheet.markdown()
        write_json(folder / "benchmark.json", report)
        wide = None if sys.stdout.isatty() else 120
        Console(width=wide).print(sheet.table())
        for note in sheet.notes:
            print(note)
    write_atomically(folder / "benchmark.md", document.encode())
    print(f"done: {cli.shown(folder if config.part == 'all' else folder / 'benchmark.json')}")


def measure_model(config: DictConfig) -> tuple[dict[str, Any], Sheet]:
    """A prediction, a training step, or the network beside a peer."""
    choose("mode", config.mode, ["predict", "train"])
    choose("vs", config.vs, [None, "transformers"])
    if config.vs is not None:
        return compare(config)
    return measure_step(config) if config.mode == "train" else measure_network(config)


def check_effect(config: DictConfig) -> None:
    """Raises ``InputError`` for a setting without effect: the figures would not be of it."""
    if config.part != "model":
        for name, default in (("mode", "predict"), ("vs", None)):
            if config[name] != default:
                raise InputError(
                    f"{name}={config[name]}: part={config.part} has none: leave it out"
                )
    if config.vs is not None and config.mode == "train":
        raise InputError(f"vs={config.vs}: compares predictions: leave out mode=train")
    if config.compile and config.vs is None and config.part != "all":
        raise InputError("compile=true: only beside another project: give vs=transformers too")


def check_trainer_settings(overrides: Iterable[str]) -> None:
    """Raises ``InputError`` for a setting of the trainer that a measured step does not take."""
    for text in overrides:
        group, _, name = text.lstrip("+").partition("=")[0].partition(".")
        if group == "trainer" and name in OWN_SETTINGS:
            own = OWN_SETTINGS[name]
            raise InputError(f"{text}: has no effect here: give {own}=... in its place")


def choose(setting: str, value: Any, known: list[Any]) -> None:
    """Raises ``InputError`` if a value is none of those known."""
    if value not in known:
        names = ", ".join("null" if name is None else name for name in known)
        raise InputError(f"{setting}={value}: choose one of {names}")
