"""Finding earlier runs: what ``init_from=auto`` and ``resume=auto`` start from."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from occdetr.errors import InputError
from occdetr.training.checkpoint import Checkpoint, read_checkpoint
from occdetr.training.compare_settings import (
    differences,
    fixed_differences,
    listed,
    select,
    source_differences,
)
from occdetr.training.renames import migrate
from occdetr.training.run_checkpoint import BEST, LAST, PREVIOUS, keep_as

CONFIG_FILE, METRICS_FILE = "config.yaml", "metrics.json"
_OVERRIDES = ".hydra/overrides.yaml"

#: Overrides that are not compared to tell the runs of a study apart.
_NOT_COMPARED = ("stage=", "resume=", "init_from=", "outputs=", "hydra", "logger", "callbacks")


class FinishedError(InputError):
    """A run that is to be resumed has finished; ``folder`` is its folder."""

    def __init__(self, message: str, folder: Path) -> None:
        super().__init__(message)
        self.folder = folder


@dataclass(frozen=True, eq=False)
class Run:
    """A folder with a checkpoint, and the configuration and the overrides of its run."""

    folder: Path
    config: dict[str, Any]
    overrides: list[str]

    @property
    def finished(self) -> bool:
        return (self.folder / METRICS_FILE).is_file()


def runs_of(outputs: str | Path, stage: str) -> list[Run]:
    """The runs below ``outputs/<stage>`` that have written a checkpoint, the newest first."""
    found = []
    for folder in Path(outputs).glob(f"{stage}/*/"):
        config = _read_yaml(folder / CONFIG_FILE)
        written = [f.stat().st_mtime_ns for f in (folder / LAST, folder / PREVIOUS) if f.is_file()]
        if written and isinstance(config, dict):
            overrides = _read_yaml(folder / _OVERRIDES) or []
            found.append((max(written), Run(folder, migrate(config), overrides)))
    return [run for _, run in sorted(found, key=lambda each: each[0], reverse=True)]


def pretraining_for(settings: Mapping[str, Any], overrides: Sequence[str]) -> Path:
    """What ``init_from=auto`` starts from: the finished pretraining with the same network,
    partition, query selection, seed and data; if there are several, the one with the same
    ``overrides``.

    Raises ``InputError``, which lists the candidates, if there is none or more than one.
    """
    found = {run: _misfits(run, settings) for run in runs_of(settings["outputs"], "pretrain")}
    fitting = [run for run, misfits in found.items() if not misfits]
    same = [run for run in fitting if _compared(run.overrides) == _compared(overrides)]
    chosen = same if len(fitting) > 1 else fitting
    if len(chosen) == 1:
        return chosen[0].folder / LAST
    if fitting:
        changed = {run: _changed(run.overrides, overrides) for run in fitting}
        text = _shown({run: text or "the same settings" for run, text in changed.items()})
        raise InputError(
            f"init_from=auto: {len(fitting)} pretrainings fit, {text}: give init_from=<path>"
        )
    text = f" ({_shown(found)})" if found else ""
    raise InputError(
        f"init_from=auto: no pretraining of model={settings['model_name']} fits below "
        f"{Path(settings['outputs']) / 'pretrain'}{text}: run stage=pretrain first, or give "
        "init_from=scratch or init_from=<path>"
    )


def _misfits(run: Run, settings: Mapping[str, Any]) -> str:
    if not run.finished:
        return "not finished"
    return listed(source_differences(run.config, settings))


def _compared(overrides: Sequence[str]) -> set[str]:
    return {text for text in overrides if not text.lstrip("+~").startswith(_NOT_COMPARED)}


def _changed(theirs: Sequence[str], ours: Sequence[str]) -> str:
    """Overrides that one of two runs has and the other has not; empty if there are none."""
    old, new = _compared(theirs), _compared(ours)
    parts = [f"it has {' '.join(sorted(old - new))}"] if old - new else []
    parts += [f"without {' '.join(sorted(new - old))}"] if new - old else []
    return ", ".join(parts)


def other_overrides(checkpoint: Path, overrides: Sequence[str]) -> str:
    """How the overrides of a checkpoint's run differ from ``overrides``; empty if they do not."""
    return _changed(_read_yaml(checkpoint.parent / _OVERRIDES) or [], overrides)


def _shown(candidates: Mapping[Run, str], most: int = 5) -> str:
    """Candidates with what is to be said of each, in one line."""
    parts = [f"{run.folder / LAST}: {text}" for run, text in list(candidates.items())[:most]]
    rest = len(candidates) - len(parts)
    return "; ".join([*parts, f"and {rest} more"] if rest else parts)


def run_to_resume(
    settings: Mapping[str, Any], warn: Callable[[str], None], of_sweep: bool = False
) -> Checkpoint | None:
    """What ``resume=auto`` continues: the newest checkpoint of a run with the same settings.

    If there is none, one of a run whose settings differ in what may change, unless there are
    several such; not in a job of a sweep, where that would be another job's. A damaged checkpoint
    is reported to ``warn`` and passed over. None if there is no such run.

    Raises ``InputError`` if it is not clear which run is meant, or it has finished.
    """
    stage, resume = settings["stage_name"], f"resume={settings['resume']}"
    found = runs_of(settings["outputs"], stage)
    fitting = [run for run in found if not fixed_differences(run.config, settings)]
    same = [run for run in fitting if not differences(run.config, settings)]
    others = [run for run in fitting if differences(run.config, fitting[0].config)]
    if not same and of_sweep:
        return None
    if not same and others:
        both = "; ".join(
            f"{run.folder} ({listed(differences(run.config, settings))})"
            for run in (fitting[0], others[0])
        )
        raise InputError(
            f"{resume}: runs of several settings would fit: {both}: give resume=<run folder>"
        )
    for run in same or fitting:
        if run.finished and not _goes_further(settings, run.config):
            raise finished_error(f"{resume}: {run.folder}", run.folder, settings)
        checkpoint = whole_checkpoint(run.folder, warn)
        if checkpoint is not None:
            return checkpoint
    return None


def whole_checkpoint(folder: Path, warn: Callable[[str], None]) -> Checkpoint | None:
    """A run's last checkpoint, or if it is damaged the one before; each is reported to ``warn``."""
    for name in (LAST, PREVIOUS):
        if (folder / name).is_file():
            try:
                return read_checkpoint(folder / name)
            except InputError as error:
                warn(str(error))
    return None


def check_resumable(checkpoint: Checkpoint, settings: Mapping[str, Any], setting: str) -> None:
    """Raises ``InputError`` if a run with ``settings`` cannot continue from ``checkpoint``."""
    if not checkpoint.resumable:
        raise InputError(
            f"{setting}: {checkpoint.path} has no state of an optimizer: start from its weights "
            f"with init_from={checkpoint.path}"
        )
    fixed = fixed_differences(checkpoint.config, settings)
    if fixed:  # a setting stands in the nodes that follow it too: name it as it was typed
        path, old, new = min(fixed, key=lambda each: each[0].count("."))
        old, new = ("null" if value is None else value for value in (old, new))
        raise InputError(
            f"{setting}: its run has {path}={old}, this one {new}, which cannot change in the "
            "middle of a run: give the same, or leave resume out"
        )
    limits = [select(settings, f"trainer.{name}") for name in ("max_epochs", "max_steps")]
    finished = (checkpoint.path.parent / METRICS_FILE).is_file()  # else something may be left to do
    for reached, limit in zip((checkpoint.epochs, checkpoint.steps), limits, strict=True):
        if limit is not None and (0 <= limit < reached or (limit == reached and finished)):
            subject, folder = f"{setting}: {checkpoint.path}", checkpoint.path.parent
            raise finished_error(subject, folder, settings)


def carry_on(checkpoint: Checkpoint, folder: Path) -> None:
    """Give the folder of a resumed run what the run has so far: its best and its last checkpoint.

    The last one comes last, since it makes the folder one to resume from. A damaged best one is
    left behind with a warning: the best is then counted anew.
    """
    old = checkpoint.path.parent
    if old.resolve() == folder.resolve():
        return
    if (old / BEST).is_file():
        try:
            read_checkpoint(old / BEST)
            keep_as(old / BEST, folder / BEST)
        except InputError as error:
            warnings.warn(f"{error}; the best score is counted anew", stacklevel=2)
    keep_as(checkpoint.path, folder / LAST)


def finished_error(subject: str, folder: Path, settings: Mapping[str, Any]) -> FinishedError:
    limits = {key: select(settings, f"trainer.{key}") for key in ("max_epochs", "max_steps")}
    name = "max_steps" if limits["max_steps"] not in (None, -1) else "max_epochs"
    message = f"{subject}: that run has finished: raise trainer.{name} (now {limits[name]})"
    return FinishedError(message, folder)


def _goes_further(settings: Mapping[str, Any], saved: Mapping[str, Any]) -> bool:
    def limit(config: Mapping[str, Any], key: str) -> float:
        value = select(config, f"trainer.{key}")
        return float("inf") if value in (None, -1) else float(value)

    return any(limit(settings, key) > limit(saved, key) for key in ("max_epochs", "max_steps"))


def _read_yaml(path: Path) -> Any:
    """None if it cannot be read."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return None
