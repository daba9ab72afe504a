"""Train a stage: ``python -m occdetr.train stage=pretrain|full model=... data=...``."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from occdetr.cli import entry as cli
from occdetr.cli.folders import free, remove_leftovers
from occdetr.cli.hyperparameters import hyperparameters
from occdetr.cli.overrides import command_line
from occdetr.cli.starting_point import in_sweep, say, starting_point, warn
from occdetr.errors import InputError
from occdetr.files import write_atomically, write_json
from occdetr.models.compilation import compile_network
from occdetr.training.board import RunCard
from occdetr.training.callbacks import ValidationRecord
from occdetr.training.checkpoint import Checkpoint, load_initial
from occdetr.training.compare_settings import PRECISION, select
from occdetr.training.device import peak_memory_mb
from occdetr.training.find_checkpoint import (
    CONFIG_FILE,
    METRICS_FILE,
    FinishedError,
    carry_on,
)
from occdetr.training.precision import resolve_precision
from occdetr.training.run_checkpoint import BEST, LAST, LastCheckpoint, RunCheckpoint
from occdetr.training.settings import (
    check_input,
    check_monitors,
    check_training,
    classes_without_a_part,
)
from occdetr.training.stop_signals import StoppedBySignal, own_exit_code
from occdetr.training.trainer import is_main_process, make_trainer, run, seed_everything


@cli.entry_point("train")
def main(config: DictConfig) -> float | None:
    """Train, and leave checkpoints, logs, the config and ``metrics.json`` in the run's folder.

    Returns the best value of ``config.monitor``: the objective of a sweep, to be maximised.
    """
    seed_everything(config.seed)
    folder = cli.run_folder()
    try:
        resume, initial = starting_point(cli.plain(config))
    except FinishedError as finished:
        if config.resume != "allow" or not in_sweep():
            raise
        return _score_before(finished.folder, folder)
    settings = settle(config, folder, resume, initial)
    model = cli.build(config.model)
    if initial:
        say(f"init_from: {load_initial(model, initial)}")
    module = cli.build(config.module, model=model)
    module.save_hyperparameters(settings)
    datamodule = cli.build(config.data)
    check_training(cli.plain(config.trainer))
    check_monitors(module, config.monitor, cli.chosen_nodes(config, "callbacks"))
    check_input(model, datamodule)
    if left_out := classes_without_a_part(model):
        warn(left_out)
    record, best = ValidationRecord(), RunCheckpoint(folder, config.monitor)
    card = run_card(settings, record, best)
    callbacks = [record, *chosen_callbacks(config, folder), best, card]
    loggers = chosen_loggers(config, folder)
    trainer: Any = make_trainer(
        cli.build(config.trainer, _partial_=True), folder, callbacks, loggers
    )
    if config.compile:
        compile_network(model, trainer.strategy.root_device)
    say(f"run: {cli.shown(folder)}")
    seconds = fit(trainer, module, datamodule, folder, resume)
    if trainer.fast_dev_run:
        say(f"done: fast_dev_run, {trainer.global_step} steps; nothing is saved")
        return _score(config.monitor, trainer, best)
    if not record.validations:  # stopped before its first one
        run(trainer, trainer.validate, module, datamodule, verbose=False)
    score = _score(config.monitor, trainer, best)
    if trainer.is_global_zero:
        write_json(folder / METRICS_FILE, _summary(config, trainer, score, seconds, record))
        outcome, command = _outcome(config, trainer, score, seconds), _next_command(config, folder)
        print(f"done: {cli.shown(folder)}, {outcome}; next: {command}")
    return score


def settle(
    config: DictConfig, folder: Path, resume: Checkpoint | None, initial: Checkpoint | None
) -> dict[str, Any]:
    """The settings of a run, written into its folder; ``config`` gets what they leave open.

    A resumed run carries on the files of its checkpoint's folder.
    """
    if resume or initial:
        config.model.backbone.weights = None  # they are in the checkpoint
    if config.trainer.get("precision") == "auto":
        config.trainer.precision = precision_of_auto(config.trainer.accelerator, resume)
    settings = cli.plain(config)
    if is_main_process():
        write_atomically(folder / CONFIG_FILE, OmegaConf.to_yaml(settings).encode())
        if resume:
            carry_on(resume, folder)
            remove_leftovers(resume.path.parent)
    return settings


def fit(
    trainer: Any, module: Any, datamodule: Any, folder: Path, resume: Checkpoint | None
) -> float:
    """Train to the end; returns the seconds that it took.

    A signal ends the process, with the command that continues. Raises ``InputError`` if no step was
    taken.
    """
    began = time.monotonic()
    path = resume.path if resume else None
    try:
        run(trainer, trainer.fit, module, datamodule, ckpt_path=path, weights_only=True)
    except StoppedBySignal as stop:
        command = _command(resume=cli.shown(folder))
        say(f"stopped by {stop.name} after {trainer.global_step} steps; continue with: {command}")
        sys.exit(stop.code if own_exit_code(trainer) else 0)
    seconds = time.monotonic() - began
    if not trainer.fast_dev_run and trainer.is_global_zero and not (folder / LAST).is_file():
        raise InputError(f"no step was taken: raise trainer.max_epochs (now {trainer.max_epochs})")
    return seconds


def precision_of_auto(accelerator: str, resume: Checkpoint | None) -> Any:
    """The precision of a run that leaves it open; a resumed one keeps that of its beginning."""
    begun_in = select(resume.config, PRECISION) if resume else None
    return resolve_precision(begun_in or "auto", accelerator)


def chosen_callbacks(config: DictConfig, folder: Path) -> list[Any]:
    """The callbacks of the group ``callbacks``, and what writes ``last.ckpt``, chosen or not."""
    nodes = cli.chosen_nodes(config, "callbacks")
    built = [
        cli.build(node, **({"folder": folder} if name == "checkpoint" else {}))
        for name, node in nodes.items()
    ]
    return built if "checkpoint" in nodes else [*built, LastCheckpoint(folder)]


def chosen_loggers(config: DictConfig, folder: Path) -> list[Any]:
    """The loggers of the group ``logger``; those with ``save_dir=null`` write into the folder."""
    own = {"save_dir": str(folder)}
    return [
        cli.build(node, **(own if node.get("save_dir", "elsewhere") is None else {}))
        for node in cli.chosen_nodes(config, "logger").values()
    ]


def run_card(settings: dict[str, Any], record: ValidationRecord, best: RunCheckpoint) -> RunCard:
    """What tells the loggers who the run is, and what came out."""
    command = command_line("occdetr.train", HydraConfig.get().overrides.task)
    values = hyperparameters(settings)
    return RunCard(command, OmegaConf.to_yaml(settings), values, record, best)


def _score(monitor: str, trainer: Any, best: Any) -> float | None:
    """The best value of the monitored figure; None if nothing was validated."""
    score = best.best_model_score
    score = trainer.callback_metrics.get(monitor) if score is None else score
    return None if score is None else float(score)


def _score_before(finished: Path, own: Path) -> float | None:
    """The result of a job that a sweep, started again, has finished before."""
    say(f"done before: {cli.shown(finished)}")
    free(own, made=True)
    return json.loads((finished / METRICS_FILE).read_text(encoding="utf-8"))["best"]["value"]


def _summary(
    config: DictConfig, trainer: Any, score: float | None, seconds: float, record: ValidationRecord
) -> dict[str, Any]:
    """The content of ``metrics.json``."""
    last = dict(record.validations[-1]) if record.validations else {}  # of a resumed run too
    last.pop("step", None)
    return {
        "stage": config.stage_name,
        "model": config.model_name,
        "epochs": trainer.current_epoch,
        "steps": trainer.global_step,
        "seconds": round(seconds, 1),
        "peak_memory_mb": round(peak_memory_mb(trainer.strategy.root_device), 1),
        "best": {"metric": config.monitor, "value": score},
        "metrics": {f"val/{name}": value for name, value in last.items()},
        "validations": record.validations,
    }


def _outcome(config: DictConfig, trainer: Any, score: float | None, seconds: float) -> str:
    figure = "no validation" if score is None else f"best {config.monitor} {score:.4f}"
    return f"{figure}, {trainer.global_step} steps in {seconds:.0f} s"


def _next_command(config: DictConfig, folder: Path) -> str:
    """What goes on from this run: the second stage with the same settings, or an evaluation."""
    best, last = folder / BEST, folder / LAST
    if config.stage_name != "pretrain":
        chosen = best if best.is_file() else last
        return command_line("occdetr.evaluate", [f"checkpoint={cli.shown(chosen)}"])
    return _command(stage="full", init_from=cli.shown(last))


def _command(**settings: Any) -> str:
    """A training with this run's overrides and other ``settings``, to be pasted into a shell."""
    own = ("resume=", "init_from=", "hydra.", *(f"{name}=" for name in settings))
    given = [text for text in HydraConfig.get().overrides.task if not text.startswith(own)]
    changed = [f"{name}={value}" for name, value in settings.items()]
    return command_line("occdetr.train", [*changed, *given])


if __name__ == "__main__":
    main()
