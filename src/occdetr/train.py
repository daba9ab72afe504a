"""Train a stage: ``python -m occdetr.train stage=pretrain|full model=... data=...``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from occdetr.cli import entry as cli
from occdetr.cli.overrides import command_line
from occdetr.errors import InputError
from occdetr.files import write_atomically, write_json
from occdetr.training.callbacks import ValidationRecord
from occdetr.training.checkpoint import load_model_state, read_checkpoint
from occdetr.training.device import peak_memory_mb
from occdetr.training.find_checkpoint import CONFIG_FILE, check_same_model, newest_run
from occdetr.training.trainer import (
    BEST,
    LAST,
    checkpoint_callbacks,
    is_main_process,
    make_trainer,
    run,
    seed_everything,
)


@cli.entry_point("train")
def main(config: DictConfig) -> float | None:
    """Train, and leave checkpoints, logs, the config and ``metrics.json`` in the run's folder.

    Returns the best value of ``config.monitor``: the objective of a sweep, to be maximised.
    """
    seed_everything(config.seed)
    folder = cli.run_folder()
    resume, initial = starting_point(cli.plain(config))
    if resume or initial:
        config.model.backbone.weights = None  # they are in the checkpoint
    settings = cli.plain(config)
    if is_main_process():
        write_atomically(folder / CONFIG_FILE, OmegaConf.to_yaml(settings).encode())
    model = cli.build(config.model)
    if initial:
        load_model_state(model, read_checkpoint(initial).model_state)
    module = cli.build(config.module, model=model)
    module.save_hyperparameters(settings)
    datamodule = cli.build(config.data)
    record, (best, last) = ValidationRecord(), checkpoint_callbacks(folder, config.monitor)
    callbacks = [record, *cli.build_all(config.get("callbacks")), best, last]
    loggers = chosen_loggers(config, folder)
    trainer: Any = make_trainer(
        cli.build(config.trainer, _partial_=True), folder, callbacks, loggers
    )
    _say(f"run: {cli.shown(folder)}")
    began = time.monotonic()
    run(trainer, trainer.fit, module, datamodule, ckpt_path=resume, weights_only=True)
    seconds = time.monotonic() - began
    if trainer.fast_dev_run:
        _say(f"done: fast_dev_run, {trainer.global_step} steps; nothing is saved")
        return _score(config.monitor, trainer, best)
    if trainer.is_global_zero and not (folder / f"{LAST}.ckpt").is_file():
        reason = f"resume={resume}: that run has finished" if resume else "no step was taken"
        raise InputError(f"{reason}: raise trainer.max_epochs (now {config.trainer.max_epochs})")
    if config.monitor not in trainer.callback_metrics:  # stopped before its first validation
        run(trainer, trainer.validate, module, datamodule, verbose=False)
    score = _score(config.monitor, trainer, best)
    if trainer.is_global_zero:
        write_json(folder / "metrics.json", _summary(config, trainer, score, seconds, record))
        outcome, command = _outcome(config, trainer, score, seconds), _next_command(config, folder)
        print(f"done: {cli.shown(folder)}, {outcome}; next: {command}")
    return score


def chosen_loggers(config: DictConfig, folder: Path) -> list[Any]:
    """The loggers of the group ``logger``; those with ``save_dir=null`` write into the folder."""
    return [
        cli.build(node, **{key: str(folder) for key in node if key == "save_dir" and not node[key]})
        for node in (config.get("logger") or {}).values()
    ]


def starting_point(settings: dict[str, Any]) -> tuple[Path | None, Path | None]:
    """The checkpoints to resume from and to take weights from; prints which.

    Raises ``InputError`` if a checkpoint is not there or does not fit.
    """
    stage, outputs, initial = settings["stage_name"], settings["outputs"], settings["init_from"]
    if settings["resume"] is not None:
        checkpoint = _resumed_run(settings)
        _say(f"resuming: {cli.shown(checkpoint)}")
        return checkpoint, None
    if stage == "pretrain" or initial == "scratch":
        return None, None
    if initial == "auto":
        found = newest_run(outputs, "pretrain", settings)
        if found is None:
            raise InputError(
                f"stage={stage}: no pretraining of model={settings['model_name']} below "
                f"{Path(outputs) / 'pretrain'}: run stage=pretrain first, or give "
                "init_from=scratch or init_from=<checkpoint>"
            )
    else:
        found = Path(initial)
        check_same_model(read_checkpoint(found).config, settings, f"init_from={found}")
    _say(f"starting from: {cli.shown(found)}")
    return None, found


def _resumed_run(settings: dict[str, Any]) -> Path:
    stage = settings["stage_name"]
    if settings["resume"] == "auto":
        found = newest_run(settings["outputs"], stage, settings, same_partition=True)
        if found is None:
            raise InputError(
                f"resume=auto: no run of stage={stage} model={settings['model_name']} below "
                f"{Path(settings['outputs']) / stage}: leave resume out, or give "
                "resume=<checkpoint>"
            )
        return found
    found = Path(settings["resume"])
    checkpoint = read_checkpoint(found)
    if checkpoint.stage != stage:
        raise InputError(
            f"resume={found}: it is of stage={checkpoint.stage}: give stage={checkpoint.stage}, "
            f"or start stage={stage} from its weights with init_from={found}"
        )
    check_same_model(checkpoint.config, settings, f"resume={found}", same_partition=True)
    return found


def _score(monitor: str, trainer: Any, best: Any) -> float | None:
    """The best value of the monitored figure; None if nothing was validated."""
    score = best.best_model_score
    score = trainer.callback_metrics.get(monitor) if score is None else score
    return None if score is None else float(score)


def _summary(
    config: DictConfig, trainer: Any, score: float | None, seconds: float, record: ValidationRecord
) -> dict[str, Any]:
    """The content of ``metrics.json``."""
    values = {name: float(value) for name, value in trainer.callback_metrics.items()}
    return {
        "stage": config.stage_name,
        "model": config.model_name,
        "epochs": trainer.current_epoch,
        "steps": trainer.global_step,
        "seconds": round(seconds, 1),
        "peak_memory_mb": round(peak_memory_mb(trainer.strategy.root_device), 1),
        "best": {"metric": config.monitor, "value": score},
        "metrics": {name: value for name, value in values.items() if name.startswith("val")},
        "validations": record.validations,
    }


def _outcome(config: DictConfig, trainer: Any, score: float | None, seconds: float) -> str:
    figure = "no validation" if score is None else f"best {config.monitor} {score:.4f}"
    return f"{figure}, {trainer.global_step} steps in {seconds:.0f} s"


def _next_command(config: DictConfig, folder: Path) -> str:
    """What goes on from this run: the second stage with the same settings, or an evaluation."""
    best, last = folder / f"{BEST}.ckpt", folder / f"{LAST}.ckpt"
    if config.stage_name != "pretrain":
        chosen = best if best.is_file() else last
        return command_line("occdetr.evaluate", [f"checkpoint={cli.shown(chosen)}"])
    own = ("stage=", "resume=", "init_from=", "hydra.")
    rest = [text for text in HydraConfig.get().overrides.task if not text.startswith(own)]
    return command_line("occdetr.train", ["stage=full", f"init_from={cli.shown(last)}", *rest])


def _say(line: str) -> None:
    if is_main_process():
        print(line, flush=True)


if __name__ == "__main__":
    main()
