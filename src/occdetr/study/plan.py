"""Plan and run the studies of docs/results.md: ``python -m occdetr.study name=...``."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from occdetr.cli import entry as cli
from occdetr.cli.folders import taken
from occdetr.cli.overrides import command_line, refuse_overrides
from occdetr.cli.shards import share_of
from occdetr.errors import InputError
from occdetr.files import check_folder, write_json
from occdetr.study.arm import StudyRun, perform, start_facts
from occdetr.training.checkpoint import read_checkpoint
from occdetr.training.compare_settings import select

_RUNS = "a study sets this for each run: leave it out, and choose runs with arms= and seeds="
_ARM = "this is what arms of a study differ in: leave it out, and choose runs with arms="
_START = "a study sets what its runs start from: leave it out, or give start=<checkpoint> beside it"
_PLACE = "each run of a study has a folder of its own: leave it out, or give folder= beside it"
#: What overrides of a study's trainings may not change (patterns), and what to do instead.
DECIDED = {
    **dict.fromkeys(("experiment", "stage", "stage_name", "seed", "data.shuffle_seed"), _RUNS),
    **dict.fromkeys(("data.train_sequences*", "data.val_sequences*", "data.eval_split"), _RUNS),
    **dict.fromkeys(("query_selection*", "*query_content", "*early_matching_share"), _ARM),
    **dict.fromkeys(("partition*", "*_classes", "*.classes", "model.detector"), _ARM),
    **dict.fromkeys(("*selection.content",), _ARM),
    **dict.fromkeys(("init_from", "resume"), _START),
    **dict.fromkeys(("outputs", "hydra", "hydra[./]*"), _PLACE),
}


@cli.entry_point("study", takes_folder=False)
def main(config: DictConfig) -> None:
    """Run a study and write one JSON file per run, ``<results>/<study>/<arm>_seed<k>.json``.

    Several jobs may do so side by side: each run has a file and a folder of its own.
    """
    study = read_study(cli.required(config, "name", "convergence"))
    runs = share_of(planned_runs(config, study), config.shard)
    for run in {run.arm: run for run in runs}.values():
        run.settings()  # an invalid override is reported now, not after hours of training
    results = Path(config.results) / config.name
    check_folder("results", results, writable=True)
    paths = {run: results / f"{run.name}.json" for run in runs}
    for run, path in paths.items():
        has_record(path, run, config.rebuild)  # an unfit file is reported now too
    for number, (run, path) in enumerate(paths.items(), start=1):
        progress = f"{number} of {len(runs)}"
        if not config.rebuild and has_record(path, run):
            print(f"=== {progress}: {cli.shown(path)} already exists", flush=True)
            continue
        print(f"\n=== {progress}: {run.study}, {run.arm}, seed {run.seed}", flush=True)
        place = Path(config.folder) / run.study / run.name
        with taken(place, "study", "folder", again=True) as folder:
            record = {"command": repeat_command(run), **perform(run, folder, study["latency"])}
            write_json(path, record)
    share = "" if config.shard == "1/1" else f" of shard={config.shard}"
    print(
        f"done: {len(runs)} runs{share} in {cli.shown(results)}; "
        "next: python -m occdetr.study.results"
    )


def has_record(path: Path, run: StudyRun, rebuild: bool = False) -> bool:
    """Whether ``path`` holds the record of this run already.

    Raises ``InputError`` if it holds anything else, and, unless ``rebuild``, if the record was made
    with other settings or from another starting checkpoint.
    """
    if not path.exists():
        return False
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        same = (found["study"], found["arm"], found["seed"]) == (run.study, run.arm, run.seed)
        settings = _settings_of(str(found.get("command", "")))
    except (OSError, ValueError, KeyError, TypeError):
        same, found, settings = False, {}, []
    if not same:
        raise InputError(
            f"{path}: is not the record of {run.name}: move it away, or set results to another "
            "folder"
        )
    remedy = "give rebuild=true to replace it, or set results to another folder"
    if not rebuild and settings != _settings_of(repeat_command(run)):
        raise InputError(f"{path}: was made with other settings ({found.get('command')}): {remedy}")
    if not rebuild and _started_elsewhere(found, run):
        raise InputError(
            f"{path}: was made from another checkpoint than start={run.start} is now: {remedy}"
        )
    return True


def _started_elsewhere(record: Mapping[str, Any], run: StudyRun) -> bool:
    """Whether the file of the starting checkpoint is not the one that a record was made from."""
    if run.start is None:
        return False
    return select(record, "start.sha256") != start_facts(run.start)["sha256"]


def _settings_of(command: str) -> list[str]:
    """The words of a study's command that its results depend on."""
    place = ("rebuild=", "results=", "folder=", "arms=", "seeds=", "shard=")
    return sorted(word for word in shlex.split(command) if not word.startswith(place))


def repeat_command(run: StudyRun) -> str:
    """The command that repeats one run of this study."""
    selection = ("arms=", "seeds=", "rebuild=", "shard=")
    given = [text for text in HydraConfig.get().overrides.task if not text.startswith(selection)]
    only = [f"arms=[{run.arm}]", f"seeds=[{run.seed}]", "rebuild=true"]
    return command_line("occdetr.study", [*given, *only])


def read_study(name: str) -> dict[str, Any]:
    """Read ``conf/study/<name>.yaml``: arms, seeds, latency, splits.

    Raises ``InputError`` if there is no such study.
    """
    known = {file.stem: file for file in sorted((cli.config_dir() / "study").glob("*.yaml"))}
    if name not in known:
        raise InputError(f"name={name}: no such study: choose one of {', '.join(known)}")
    return cli.plain(OmegaConf.load(known[name]))


def planned_runs(config: DictConfig, study: Mapping[str, Any]) -> list[StudyRun]:
    """The runs of all arms and seeds that ``config`` selects, seed by seed.

    Raises ``InputError`` if the study has no such arm or split, an override changes what it
    decides itself, or the start checkpoint is missing or of another stage.
    """
    refuse_overrides(config.overrides, DECIDED)
    arms = _selected(config, "arms", list(study["arms"]))
    if study["splits"]:  # a seed is then the index of a split
        seeds = _selected(config, "seeds", study["seeds"])
    else:
        seeds = _selected_seeds(config, study["seeds"])
    start = None
    if any(study["arms"][arm].get("start") for arm in arms):
        start = _start_checkpoint(config)
    runs = []
    for seed in seeds:
        split = split_overrides(study["splits"], seed) if study["splits"] else []
        for arm in arms:
            settings = study["arms"][arm]
            experiment = f"experiment={config.name}/{arm}"
            runs.append(
                StudyRun(
                    study=config.name,
                    arm=arm,
                    seed=seed,
                    overrides=(experiment, f"seed={seed}", *split, *config.overrides),
                    stages=tuple(settings["stages"]),
                    start=start if settings.get("start") else None,
                    baseline=settings.get("baseline", False),
                )
            )
    return runs


def _selected(config: DictConfig, key: str, available: Sequence[Any]) -> list[Any]:
    """The list ``config[key]``, all of it ``available``; by default everything available."""
    selected = _list(config, key, available)
    for value in selected:
        if value not in available:
            choices = ", ".join(map(str, available))
            raise InputError(
                f"{key}={selected}: study {config.name} has no {value}: choose from {choices}"
            )
    return selected


def _selected_seeds(config: DictConfig, default: Sequence[int]) -> list[int]:
    """The list ``config.seeds``, any non-negative integers."""
    seeds = _list(config, "seeds", default)
    if any(type(seed) is not int or seed < 0 for seed in seeds):
        raise InputError(f"seeds={seeds}: a seed must be a non-negative integer")
    return seeds


def _list(config: DictConfig, key: str, default: Sequence[Any]) -> list[Any]:
    value = cli.plain(config[key])
    if value is None:
        return list(default)
    if not isinstance(value, list) or not value:
        raise InputError(f"{key}={value}: must be a list such as [{default[0]}]")
    return value


def _start_checkpoint(config: DictConfig) -> Path:
    """The checkpoint ``config.start``, which must be of ``stage=full``."""
    path = Path(cli.required(config, "start", "tiny"))
    stage = read_checkpoint(path).stage
    if stage != "full":
        raise InputError(f"start={path}: is a checkpoint of stage={stage}: use one of stage=full")
    return path


def split_overrides(splits: Sequence[str], split: int) -> list[str]:
    """Overrides that train on all sequences ``splits`` but one, and evaluate on that one."""
    train = [sequence for sequence in splits if sequence != splits[split]]
    sequences = {"train": train, "val": [splits[split]]}
    return [f"data.{key}_sequences={json.dumps(value)}" for key, value in sequences.items()]


if __name__ == "__main__":
    main()
