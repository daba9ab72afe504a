"""Train a stage: ``python -m occdetr.train stage=pretrain|full model=... data=...``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from occdetr.cli import entry as cli
from occdetr.errors import InputError
from occdetr.files import write_atomically, write_json
from occdetr.training.callbacks import PictureLogger, StepMonitor, ValidationRecord
from occdetr.training.checkpoint import load_model_state, read_checkpoint
from occdetr.training.find_checkpoint import CONFIG_FILE, check_same_model, newest_run
from occdetr.training.trainer import (
    BEST,
    LAST,
    is_main_process,
    make_trainer,
    peak_memory_mb,
    run,
    seed_everything,
    training_callbacks,
)


@cli.entry_point("train")
def main(config: DictConfig) -> None:
    """Train, and leave checkpoints, logs, the config and ``metrics.json`` in the run's folder."""
    seed_everything(config.seed)
    folder = cli.run_folder()
    resume, initial = starting_point(config)
    if resume or initial:
        config.model.backbone.weights = None  # they are in the checkpoint
    settings = cli.plain(config)
    if is_main_process():
        write_atomically(folder / CONFIG_FILE, OmegaConf.to_yaml(settings).encode())
    model = cli.build(config.model)
    if initial:
        load_model_state(model, read_checkpoint(initial).model_state)
    module = cli.build(config.module, model=model)
    module.run_config = settings
    datamodule = cli.build(config.data)
    record = ValidationRecord()
    callbacks = [record, StepMonitor(), PictureLogger()]
    callbacks += training_callbacks(folder, config.monitor)
    trainer = make_trainer(folder, settings["trainer"], callbacks, log=True)
    _say(f"run: {cli.shown(folder)}")
    began = time.monotonic()
    run(trainer, trainer.fit, module, datamodule, ckpt_path=resume, weights_only=True)
    if trainer.is_global_zero and not (folder / f"{LAST}.ckpt").is_file():
        raise InputError(
            f"resume={resume}: that run has finished: raise trainer.max_epochs (now "
            f"{config.trainer.max_epochs}) to go on"
        )
    if config.monitor not in trainer.callback_metrics:  # stopped before its first validation
        run(trainer, trainer.validate, module, datamodule, verbose=False)
    if trainer.is_global_zero:
        _finish(config, trainer, folder, time.monotonic() - began, record.validations)


def starting_point(config: DictConfig) -> tuple[Path | None, Path | None]:
    """The checkpoints to resume from and to take weights from; says which.

    Raises ``InputError`` if what was asked for is not there or does not fit.
    """
    stage, outputs = config.stage_name, config.outputs
    if config.resume is not None:
        checkpoint = _resumed_run(config)
        _say(f"resuming: {cli.shown(checkpoint)}")
        return checkpoint, None
    if stage == "pretrain" or config.init_from == "scratch":
        return None, None
    if config.init_from == "auto":
        found = newest_run(outputs, "pretrain", config)
        if found is None:
            raise InputError(
                f"stage={stage}: no pretraining of model={config.model_name} below "
                f"{Path(outputs) / 'pretrain'}: run stage=pretrain first, or give "
                "init_from=scratch or init_from=<checkpoint>"
            )
    else:
        found = Path(config.init_from)
        check_same_model(read_checkpoint(found).config, config, f"init_from={found}")
    _say(f"starting from: {cli.shown(found)}")
    return None, found


def _resumed_run(config: DictConfig) -> Path:
    stage = config.stage_name
    if config.resume == "auto":
        found = newest_run(config.outputs, stage, config, same_partition=True)
        if found is None:
            raise InputError(
                f"resume=auto: no run of stage={stage} model={config.model_name} below "
                f"{Path(config.outputs) / stage}: leave resume out, or give resume=<checkpoint>"
            )
        return found
    found = Path(config.resume)
    checkpoint = read_checkpoint(found)
    if checkpoint.stage != stage:
        raise InputError(
            f"resume={found}: it is of stage={checkpoint.stage}: give stage={checkpoint.stage}, "
            f"or start stage={stage} from its weights with init_from={found}"
        )
    check_same_model(checkpoint.config, config, f"resume={found}", same_partition=True)
    return found


def _finish(
    config: DictConfig,
    trainer: Any,
    folder: Path,
    seconds: float,
    validations: list[dict[str, float]],
) -> None:
    """Write ``metrics.json`` and say what came out and what to do next."""
    values = {name: float(value) for name, value in trainer.callback_metrics.items()}
    best = trainer.checkpoint_callbacks[0].best_model_score
    score = values[config.monitor] if best is None else float(best)
    last = folder / f"{LAST}.ckpt"
    summary = {
        "stage": config.stage_name,
        "model": config.model_name,
        "epochs": trainer.current_epoch,
        "steps": trainer.global_step,
        "seconds": round(seconds, 1),
        "peak_memory_mb": round(peak_memory_mb(trainer.strategy.root_device), 1),
        "best": {"metric": config.monitor, "value": score},
        "metrics": {name: value for name, value in values.items() if name.startswith("val")},
        "validations": validations,
    }
    write_json(folder / "metrics.json", summary)
    chosen = folder / f"{BEST}.ckpt"
    chosen = chosen if chosen.is_file() else last
    if config.stage_name == "pretrain":
        own = ("stage=", "resume=", "init_from=", "hydra.")
        rest = [text for text in HydraConfig.get().overrides.task if not text.startswith(own)]
        start = f"stage=full init_from={cli.shown(last)}"
        then = " ".join(["python -m occdetr.train", start, *rest])
    else:
        then = f"python -m occdetr.evaluate checkpoint={cli.shown(chosen)}"
    print(
        f"done: {cli.shown(folder)}, best {config.monitor} {score:.4f}, "
        f"{trainer.global_step} steps in {seconds:.0f} s; next: {then}"
    )


def _say(line: str) -> None:
    if is_main_process():
        print(line, flush=True)


if __name__ == "__main__":
    main()
