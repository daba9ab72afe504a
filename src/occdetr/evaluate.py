"""Measure a checkpoint: ``python -m occdetr.evaluate checkpoint=... [data=... split=val]``."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import track

from occdetr.api.viewer import Recording
from occdetr.cli import entry as cli
from occdetr.cli.checkpoint_data import checkpoint_data
from occdetr.cli.report import (
    print_diagnosis,
    print_metrics,
    print_recall,
    print_upper_bounds,
    write_confusion,
)
from occdetr.cli.sigterm import sigterm_interrupts
from occdetr.errors import InputError
from occdetr.evaluation.diagnosis import Diagnosis
from occdetr.evaluation.upper_bound import UpperBound
from occdetr.files import write_json
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.models.compilation import compile_network
from occdetr.training.callbacks import (
    DiagnosisCallback,
    FirstFrames,
    PredictionSheet,
    PredictionWriter,
)
from occdetr.training.checkpoint import UNTRAINED_GRIDS
from occdetr.training.full import FullModule
from occdetr.training.stage import StageModule
from occdetr.training.trainer import is_main_process, make_trainer, run, seed_everything


@cli.entry_point("evaluate")
def main(config: DictConfig) -> float | None:
    """Print tables and leave their figures (and pictures, predictions) in the run's folder.

    Returns the mIoU; of an upper bound, that under all losses together.
    """
    seed_everything(config.seed)
    set_threads(config.threads)
    refuse_another_network(config)
    refuse_beside_upper_bound(config)
    if config.upper_bound:
        return measure_upper_bound(config)
    path = Path(cli.required(config, "checkpoint", "outputs/full/<run>/best.ckpt"))
    if config.trainer.get("limit_test_batches") == 0:
        raise InputError("trainer.limit_test_batches=0: nothing to evaluate: give more, or null")
    module = StageModule.load_from_checkpoint(path, allow=cli.plain(config.allow))
    datamodule = evaluation_data(config, module.hparams)
    folder = cli.run_folder()
    diagnosis = None
    if config.diagnose:
        diagnosis = DiagnosisCallback(Diagnosis(module.model, trained_criterion(module)))
    recording = recording_of(config, folder)
    callbacks, files = extra_outputs(config, folder, recording)
    with sigterm_interrupts(), recording or nullcontext():
        trainer = make_trainer(
            cli.build(config.trainer, _partial_=True),
            folder,
            callbacks if diagnosis is None else [*callbacks, diagnosis],
        )
        if config.compile:
            compile_network(module.model, trainer.strategy.root_device)
        if is_main_process():
            datamodule.prepare_data()
            print(f"{cli.shown(path)} ({module.stage}) on {datamodule.summary(config.split)}")
            if module.stage == "pretrain":
                print(f"note: {UNTRAINED_GRIDS}")
        run(trainer, trainer.test, module, datamodule=datamodule, verbose=False)
    if not trainer.is_global_zero:
        return None
    measured = {
        "checkpoint": str(path),
        "data": datamodule.summary(config.split),
        "split": config.split,
        "exchange_images": config.exchange_images,
    }
    files = [*report(folder, module.results, measured, diagnosis), *files]
    if config.exchange_images:
        print("note: every frame had the picture of another one")
    count, whole = module.results["num_frames"], len(datamodule.frames(config.split))
    if count < whole:
        print(f"note: only {count} of {whole} frames, as the trainer is set")
    print(f"done: {count} frames, {', '.join(map(cli.shown, files))}")
    return module.results["mIoU"]


def extra_outputs(
    config: DictConfig, folder: Path, recording: Recording | None
) -> tuple[list[Any], list[Path]]:
    """What writes predictions, pictures and a recording, as far as they are wanted; and where."""
    callbacks: list[Any] = []
    files: list[Path] = []
    if config.save_predictions:
        callbacks.append(PredictionWriter(folder / "predictions"))
        files.append(folder / "predictions")
    if config.pictures:
        sheet = PredictionSheet(folder / "predictions.jpg", config.pictures)
        callbacks.append(sheet)
        files.append(sheet.file)
    if recording is not None:
        callbacks.append(FirstFrames(config.pictures, recording.add_frame))
        files.append(recording.file)
    return callbacks, files


def report(
    folder: Path,
    results: Mapping[str, Any],
    measured: Mapping[str, Any],
    diagnosis: DiagnosisCallback | None,
) -> list[Path]:
    """Print the tables and write their figures, with what was ``measured``; returns the files."""
    metrics = {**results, **measured}
    confusion = np.array(metrics.pop("confusion"))
    write_json(folder / "metrics.json", metrics)
    write_confusion(folder, confusion.sum(axis=0))
    print_metrics(metrics, confusion)
    print_recall(metrics["objects_found"])
    files = [folder / "metrics.json", folder / "confusion.png"]
    if diagnosis is not None:
        causes = {**diagnosis.results, **measured}
        write_json(folder / "diagnosis.json", causes)
        print_diagnosis(causes)
        files.append(folder / "diagnosis.json")
    return files


def refuse_beside_upper_bound(config: DictConfig) -> None:
    """Raises ``InputError`` for a setting that has no effect on an upper bound."""
    if not config.upper_bound:
        return
    if config.diagnose:
        raise InputError("diagnose=true: an upper bound has no errors: leave out upper_bound=true")
    for name in ("compile", "save_predictions", "exchange_images", "pictures", "viewer"):
        if config[name]:
            value = str(config[name]).lower()
            raise InputError(f"{name}={value}: an upper bound runs no network: leave it out")


def recording_of(config: DictConfig, folder: Path) -> Recording | None:
    """The file of a viewer, ``predictions.rrd``, for the main process.

    Raises ``InputError`` for an unknown one, or if it would have no frame.
    """
    if config.viewer is None:
        return None
    if config.viewer != "rerun":
        raise InputError(f"viewer={config.viewer}: is not known: use rerun or null")
    if not config.pictures:
        raise InputError("viewer=rerun: also give pictures=<number of frames>, the first so many")
    return Recording(folder / "predictions.rrd") if is_main_process() else None


def trained_criterion(module: StageModule) -> OccupancyCriterion:
    """The criterion that a network's occupancy was trained with; of a pretrained network, the one
    that ``stage=full`` would train it with."""
    if isinstance(module, FullModule):
        return module.occupancy_criterion
    given = ["stage=full", f"partition={module.hparams['partition_name']}"]
    return cli.build(cli.compose("train", given).loss.occupancy)


def refuse_another_network(config: DictConfig) -> None:
    """Raises ``InputError`` if a model or partition was chosen where the checkpoint has its own,
    or an optimizer."""
    for text in HydraConfig.get().overrides.task:
        if re.match(r"[+~]*optimizer\b", text):
            raise InputError(f"{text}: evaluate trains nothing: leave it out")
    if config.upper_bound and config.checkpoint is None:
        return
    for group in ("model", "partition"):
        choice = HydraConfig.get().runtime.choices[group]
        if choice is not None:
            raise InputError(
                f"{group}={choice}: only for upper_bound=true without a checkpoint, since a "
                f"checkpoint has its own {group}: leave it out"
            )


def measure_upper_bound(config: DictConfig) -> float:
    """Print and write (``upper_bound.json``) what a perfect network of the configured form scores.

    Returns its mIoU under all losses together.
    """
    if config.checkpoint is not None:
        module = StageModule.load_from_checkpoint(config.checkpoint, allow=cli.plain(config.allow))
        trained, model, criterion = module.hparams, module.model.eval(), trained_criterion(module)
        datamodule = evaluation_data(config, trained)
    else:
        trained = upper_bound_config()
        model, criterion = cli.build(trained.model), cli.build(trained.loss.occupancy)
        datamodule = cli.build({**cli.plain(trained.data), **of_split(config)})
    datamodule.prepare_data()
    datamodule.setup("test")
    names = {"model": trained["model_name"], "partition": trained["partition_name"]}
    print(f"perfect {', '.join(names.values())}: {datamodule.summary(config.split)}")
    bound = UpperBound(model, criterion)
    for batch in track(datamodule.test_dataloader(), description="frames", transient=True):
        bound.update(batch)
    results, path = bound.results(), cli.run_folder() / "upper_bound.json"
    number = results["all"]["num_frames"]
    report = {**names, "split": config.split, "num_frames": number, "variants": results}
    write_json(path, report)
    print_upper_bounds(report)
    print(f"done: {number} frames, {cli.shown(path)}")
    return results["all"]["mIoU"]


#: Settings of evaluate alone; all others say what the upper bound's network and data are.
OWN_SETTINGS = (
    "checkpoint", "upper_bound", "diagnose", "split", "save_predictions", "exchange_images",
    "pictures", "viewer", "batch_size", "threads", "compile", "outputs", "trainer", "allow",
    "hydra",
)  # fmt: skip


def upper_bound_config() -> DictConfig:
    """The training configuration with the model, partition and data that evaluate was given."""
    given = HydraConfig.get().overrides.task
    rest = [text for text in given if re.split(r"[.=]", text.lstrip("+~"))[0] not in OWN_SETTINGS]
    if not any(text.startswith("model=") for text in rest):
        raise InputError("upper_bound=true: give model=tiny|small|paper or checkpoint=...")
    config = cli.compose("train", ["stage=full", *rest])
    config.model.backbone.weights = None  # a perfect network needs none
    return config


def set_threads(number: int) -> None:
    """Threads of this process and of the further ranks, for which Lightning would choose others."""
    os.environ["OMP_NUM_THREADS"] = str(number)
    torch.set_num_threads(number)


def evaluation_data(config: DictConfig, trained: Any) -> Any:
    """The data module that ``config`` names, else the checkpoint's, for its network."""
    return checkpoint_data(config, trained, of_split(config))


def of_split(config: DictConfig) -> dict[str, Any]:
    """Keywords of the data module: evaluate's split and batch size.

    Raises ``InputError`` if the split has no labels.
    """
    if config.split not in ("train", "val"):
        raise InputError(
            f"split={config.split}: labels exist for train and val (for images without labels: "
            "python -m occdetr.predict)"
        )
    return {
        "eval_split": config.split,
        "batch_size": config.batch_size,
        "exchange_images": config.exchange_images,
    }


if __name__ == "__main__":
    main()
