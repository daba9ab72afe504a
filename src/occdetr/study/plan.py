"""Studies of docs/results.md: ``python -m occdetr.study name=convergence|partition|real``."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from occdetr.cli import entry as cli
from occdetr.errors import InputError
from occdetr.files import write_json
from occdetr.study.arm import StudyRun, perform
from occdetr.training.checkpoint import read_checkpoint


@cli.entry_point("study")
def main(config: DictConfig) -> None:
    """Leave a JSON file for every run, ``<results>/<study>/<arm>_seed<k>.json``."""
    study = read_study(cli.required(config, "name", "convergence"))
    runs = planned_runs(config, study)
    for run in {run.arm: run for run in runs}.values():
        run.settings()  # so that a mistake shows now, not after hours
    results = Path(config.results) / config.name
    for number, run in enumerate(runs, start=1):
        path, place = results / f"{run.name}.json", f"{number} of {len(runs)}"
        if path.is_file() and not config.rebuild:
            print(f"=== {place}: {cli.shown(path)} is there already", flush=True)
            continue
        print(f"\n=== {place}: {run.study}, {run.arm}, seed {run.seed}", flush=True)
        folder = Path(config.folder) / run.study / run.name
        record = {"command": command_line(run), **perform(run, folder, study["latency"])}
        write_json(path, record)
    print(f"done: {len(runs)} runs in {cli.shown(results)}; next: python -m occdetr.study.results")


def command_line(run: StudyRun) -> str:
    """What repeats one run of this study."""
    own = ("arms=", "seeds=", "rebuild=")
    given = [text for text in HydraConfig.get().overrides.task if not text.startswith(own)]
    only = [f"arms=[{run.arm}]", f"seeds=[{run.seed}]", "rebuild=true"]
    return shlex.join(["python", "-m", "occdetr.study", *given, *only])


def read_study(name: str) -> dict[str, Any]:
    """``conf/study/<name>.yaml``: arms, seeds, latency, splits. Raises ``InputError``."""
    known = {file.stem: file for file in sorted((cli.config_dir() / "study").glob("*.yaml"))}
    if name not in known:
        raise InputError(f"name={name}: no such study: choose one of {', '.join(known)}")
    return cli.plain(OmegaConf.load(known[name]))


def planned_runs(config: DictConfig, study: Mapping[str, Any]) -> list[StudyRun]:
    """All arms and seeds that ``config`` asks for, seed by seed.

    Raises ``InputError`` if the study has no such arm or split, or a checkpoint is missing.
    """
    arms = _chosen("arms", config.arms, list(study["arms"]), config.name)
    # any seed will do, but for those that stand for splits
    allowed = study["seeds"] if study["splits"] else None
    seeds = _chosen("seeds", config.seeds, study["seeds"], config.name, allowed)
    start = None
    if any(study["arms"][arm].get("start") for arm in arms):
        start = _start(config)
    runs = []
    for seed in seeds:
        split = held_out(study["splits"], seed) if study["splits"] else []
        for arm in arms:
            how = study["arms"][arm]
            experiment = f"experiment={config.name}/{arm}"
            runs.append(
                StudyRun(
                    *(config.name, arm, seed),
                    overrides=(experiment, f"seed={seed}", *split, *config.overrides),
                    stages=tuple(how["stages"]),
                    start=start if how.get("start") else None,
                    baseline=how.get("baseline", False),
                )
            )
    return runs


def _chosen(
    key: str, asked: Any, default: Sequence[Any], study: str, allowed: Sequence[Any] | None = ()
) -> list[Any]:
    """What was asked for of ``allowed`` (by default ``default``; None: any number from 0 on)."""
    allowed = default if allowed == () else allowed
    if asked is None:
        return list(default)
    asked = cli.plain(asked)
    if not isinstance(asked, list) or not asked:
        raise InputError(f"{key}={asked}: must be a list such as [{default[0]}]")
    for value in asked:
        if allowed is None and not (type(value) is int and value >= 0):
            raise InputError(f"{key}={asked}: a seed is a whole number from 0 on")
        if allowed is not None and value not in allowed:
            known = ", ".join(map(str, allowed))
            raise InputError(f"{key}={asked}: name={study} has no {value}: choose of {known}")
    return asked


def _start(config: DictConfig) -> Path:
    """The checkpoint that was given to start from."""
    path = Path(cli.required(config, "start", "outputs/study/partition/mixed_seed0/full/last.ckpt"))
    stage = read_checkpoint(path).stage
    if stage != "full":
        raise InputError(f"start={path}: it is of stage={stage}: give one of stage=full")
    return path


def held_out(splits: Sequence[str], split: int) -> list[str]:
    """The settings of training without one sequence, and of evaluating on it."""
    train = [sequence for sequence in splits if sequence != splits[split]]
    names = {"train": train, "val": [splits[split]]}
    return [f"data.{key}_sequences={json.dumps(value)}" for key, value in names.items()]


if __name__ == "__main__":
    main()
