"""The trainings below a folder: their settings, how far they are, and their validations."""

from __future__ import annotations

import glob
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import yaml

from occdetr.cli.folders import MARKER, in_use
from occdetr.errors import InputError
from occdetr.training.compare_settings import fixed_differences, select
from occdetr.training.find_checkpoint import CONFIG_FILE, METRICS_FILE
from occdetr.training.run_checkpoint import LAST, PREVIOUS

#: States of a run. Of these only finished ones have all their validations.
FINISHED, RUNNING, UNFINISHED, CONTINUED, BROKEN = (
    *("finished", "running", "unfinished", "continued", "broken"),
)


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """A run's folder; ``problem`` says what is broken in it.

    ``overrides`` and ``choices`` are what its user has typed, and the options of its groups.
    """

    folder: Path
    state: str
    config: Mapping[str, Any] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()
    choices: Mapping[str, Any] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    validations: tuple[Mapping[str, float], ...] = ()
    problem: str = ""

    @property
    def monitor(self) -> str | None:
        """The figure that picked its ``best.ckpt``."""
        name = self.config.get("monitor")
        return str(name).removeprefix("val/") if name else None


def find_runs(place: str) -> list[TrainingRun]:
    """The trainings in or below a folder, or the folders of a glob pattern, by their names.

    Raises ``InputError`` if there is none.
    """
    roots = [Path(place)] if os.path.isdir(place) else [Path(p) for p in glob.glob(place)]
    if not roots:
        raise InputError(f"runs={place}: no such folder: give the folder of a sweep's runs")
    folders = sorted({folder for root in roots for folder in _run_folders(root)})
    if not folders:
        raise InputError(
            f"runs={place}: no run of a training there: give a folder such as outputs/full"
        )
    return _mark_continued([read_run(folder) for folder in folders])


def _run_folders(root: Path) -> Iterator[Path]:
    """Folders that a training has taken; what is inside of them is not searched."""
    for parent, folders, files in os.walk(root):
        place = Path(parent)
        if CONFIG_FILE in files and _is_training(place):
            folders.clear()
            yield place
        folders[:] = sorted(name for name in folders if not name.startswith("."))


def _is_training(folder: Path) -> bool:
    """By its marker; of an older run, or one that was copied, by what it has left."""
    if (folder / MARKER).is_file():
        marker = _read_json(folder / MARKER)
        return isinstance(marker, dict) and marker.get("entry") == "train"
    config = _read_yaml(folder / CONFIG_FILE)
    return isinstance(config, dict) and "stage_name" in config


def read_run(folder: Path) -> TrainingRun:
    """What a run's folder says. A file that cannot be read makes the run a broken one."""
    config = _read_yaml(folder / CONFIG_FILE)
    if not isinstance(config, dict):
        return TrainingRun(folder, BROKEN, problem=f"{CONFIG_FILE} cannot be read")
    overrides = _read_yaml(folder / MARKER.parent / "overrides.yaml")
    hydra = _read_yaml(folder / MARKER.parent / "hydra.yaml")
    typed = {
        "config": config,
        "overrides": tuple(map(str, overrides if isinstance(overrides, list) else ())),
        "choices": (select(hydra, "runtime.choices") if isinstance(hydra, dict) else None) or {},
    }
    if not (folder / METRICS_FILE).is_file():
        state = RUNNING if in_use(folder) else UNFINISHED
        return TrainingRun(folder, state, **typed, validations=_validations_so_far(folder))
    summary = _read_json(folder / METRICS_FILE)
    if not isinstance(summary, dict) or not _are_validations(summary.get("validations")):
        return TrainingRun(folder, BROKEN, **typed, problem=f"{METRICS_FILE} cannot be read")
    done = tuple(summary["validations"])
    return TrainingRun(folder, FINISHED, **typed, summary=summary, validations=done)


def _validations_so_far(folder: Path) -> tuple[Mapping[str, float], ...]:
    """Those in the last whole checkpoint of a run that has not finished."""
    for name in (LAST, PREVIOUS):
        if (folder / name).is_file():
            try:
                raw = torch.load(folder / name, map_location="cpu", weights_only=True, mmap=True)
                found = raw["callbacks"]["ValidationRecord"]["validations"]
            except Exception:  # cut short, damaged, or written by another program
                continue
            if _are_validations(found):
                return tuple(found)
    return ()


def _are_validations(found: Any) -> bool:
    return isinstance(found, list) and all(
        isinstance(each, dict)
        and "step" in each
        and all(type(value) in (int, float) for value in each.values())
        for each in found
    )


def _mark_continued(runs: list[TrainingRun]) -> list[TrainingRun]:
    """A resumed run has a folder of its own, and the record of what it continues."""
    return [
        TrainingRun(**{**vars(run), "state": CONTINUED})
        if run.state == UNFINISHED and any(_continues(other, run) for other in runs)
        else run
        for run in runs
    ]


def _continues(run: TrainingRun, earlier: TrainingRun) -> bool:
    if run is earlier or run.config.get("resume") is None or not earlier.validations:
        return False
    so_far = run.validations[: len(earlier.validations)] == earlier.validations
    return so_far and not fixed_differences(earlier.config, run.config)


def _read_yaml(path: Path) -> Any:
    """None if it cannot be read."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return None


def _read_json(path: Path) -> Any:
    """None if it cannot be read."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
