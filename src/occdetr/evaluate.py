"""Measure a checkpoint: ``python -m occdetr.evaluate checkpoint=... [data=... split=val]``."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict
from rich.progress import track
from torch import Tensor

from occdetr.cli import entry as cli
from occdetr.cli.report import (
    print_diagnosis,
    print_metrics,
    print_recall,
    print_upper_bounds,
    write_confusion,
)
from occdetr.data.semantickitti import write_labels
from occdetr.errors import InputError
from occdetr.evaluation.diagnosis import Diagnosis
from occdetr.evaluation.evaluator import EvaluationModule
from occdetr.evaluation.upper_bound import Oracle
from occdetr.files import write_json
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.structures import SceneBatch
from occdetr.training.trainer import is_main_process, make_trainer, run, seed_everything


class PredictionWriter:
    """Writes ``<folder>/sequences/NN/predictions/NNNNNN.label``, as the test server takes them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, batch: SceneBatch, grids: Tensor) -> None:
        for frame_id, grid in zip(batch.frame_ids, grids.cpu().numpy(), strict=True):
            sequence, name = frame_id.split("/")
            write_labels(
                self.folder / "sequences" / sequence / "predictions" / f"{name}.label", grid
            )


@cli.entry_point("evaluate")
def main(config: DictConfig) -> None:
    """Print tables and leave their figures (and pictures, predictions) in the run's folder."""
    seed_everything(config.seed)
    set_threads(config.threads)
    refuse_another_network(config)
    if config.oracle and config.diagnose:
        raise InputError("diagnose=true: a perfect network needs none: leave out oracle=true")
    if config.oracle:
        measure_ceilings(config)
        return
    path = Path(cli.required(config, "checkpoint", "outputs/full/<run>/best.ckpt"))
    model, trained, checkpoint = cli.restore_model(path)
    datamodule = cli.build(evaluation_data(config, trained))
    folder = cli.run_folder()
    write = PredictionWriter(folder / "predictions") if config.save_predictions else None
    diagnosis = Diagnosis(model, trained_criterion(trained)) if config.diagnose else None
    module = EvaluationModule(model, write, diagnosis)
    trainer = make_trainer(folder, cli.plain(config.trainer))
    if is_main_process():
        datamodule.prepare_data()
        print(f"{cli.shown(path)} ({checkpoint.stage}) on {datamodule.summary(config.split)}")
    run(trainer, trainer.test, module, datamodule=datamodule, verbose=False)
    if not trainer.is_global_zero:
        return
    measured = {
        "checkpoint": str(path),
        "data": datamodule.summary(config.split),
        "split": config.split,
        "exchange_images": config.exchange_images,
    }
    metrics = {**module.results, **measured}
    confusion = np.array(metrics.pop("confusion"))
    write_json(folder / "metrics.json", metrics)
    write_confusion(folder, confusion.sum(axis=0))
    print_metrics(metrics, confusion)
    print_recall(metrics["objects_found"])
    files = [folder / "metrics.json", folder / "confusion.png"]
    if diagnosis is not None:
        causes = {**module.causes, **measured}
        write_json(folder / "diagnosis.json", causes)
        print_diagnosis(causes)
        files.append(folder / "diagnosis.json")
    if config.exchange_images:
        print("note: every frame had the picture of another one")
    if checkpoint.stage == "pretrain":
        print("note: pretraining trains detection only, so the voxels are those of chance")
    if write is not None:
        files.append(folder / "predictions")
    print(f"done: {metrics['num_frames']} frames, {', '.join(map(cli.shown, files))}")


def trained_criterion(trained: DictConfig) -> OccupancyCriterion:
    """What a checkpoint's network was taught to occupy or, as pretraining teaches nothing of it,
    would be in ``stage=full``."""
    criterion = trained.get("occupancy_criterion")
    if criterion is None:
        given = ["stage=full", f"partition={trained.partition_name}"]
        criterion = cli.compose("train", given).occupancy_criterion
    return cli.build(criterion)


def refuse_another_network(config: DictConfig) -> None:
    """Raises ``InputError`` if a model or partition was chosen where the checkpoint has its own."""
    if config.oracle and config.checkpoint is None:
        return
    for group in ("model", "partition"):
        choice = HydraConfig.get().runtime.choices[group]
        if choice is not None:
            raise InputError(
                f"{group}={choice}: only for oracle=true without a checkpoint, since a checkpoint "
                f"has its own {group}: leave it out"
            )


def measure_ceilings(config: DictConfig) -> None:
    """Print and write (``oracle.json``) what a perfect network of the configured form scores."""
    if config.checkpoint is not None:
        model, trained, _ = cli.restore_model(config.checkpoint)
        data = evaluation_data(config, trained)
    else:
        trained = oracle_config()
        model = cli.build(trained.model)
        data = of_split(trained.data, config)
    datamodule = cli.build(data)
    datamodule.prepare_data()
    datamodule.setup("test")
    form = f"perfect {trained.model_name}, {trained.partition_name}"
    print(f"{form}: {datamodule.summary(config.split)}")
    oracle = Oracle(model, trained_criterion(trained))
    for batch in track(datamodule.test_dataloader(), description="frames", transient=True):
        oracle.update(batch)
    results = oracle.results()
    folder = cli.run_folder()
    report = {
        "model": trained.model_name,
        "partition": trained.partition_name,
        "split": config.split,
        "num_frames": results["all"]["num_frames"],
        "variants": results,
    }
    write_json(folder / "oracle.json", report)
    print_upper_bounds(report)
    print(f"done: {report['num_frames']} frames, {cli.shown(folder / 'oracle.json')}")


#: Settings of evaluate alone; all others say what the oracle's network and data are.
OWN_SETTINGS = (
    "checkpoint", "oracle", "diagnose", "split", "save_predictions", "exchange_images",
    "batch_size", "threads", "outputs", "trainer", "hydra",
)  # fmt: skip


def oracle_config() -> DictConfig:
    """The training configuration with the model, partition and data that evaluate was given."""
    given = HydraConfig.get().overrides.task
    rest = [text for text in given if re.split(r"[.=]", text.lstrip("+~"))[0] not in OWN_SETTINGS]
    if not any(text.startswith("model=") for text in rest):
        raise InputError("oracle=true: say whose ceiling: model=tiny|small|paper or checkpoint=...")
    config = cli.compose("train", ["stage=full", *rest])
    config.model.backbone.weights = None  # a perfect network needs none
    return config


def set_threads(number: int) -> None:
    """Threads of this process and of the further ranks, for which Lightning would choose others."""
    os.environ["OMP_NUM_THREADS"] = str(number)
    torch.set_num_threads(number)


def evaluation_data(config: DictConfig, trained: DictConfig) -> DictConfig:
    """The data that ``config`` names, else the checkpoint's, for the checkpoint's network."""
    asked: Any = OmegaConf.to_container(config.data)
    given = {key: value for key, value in asked.items() if value is not None}
    if "_target_" not in given:
        trained_data: Any = OmegaConf.to_container(trained.data)
        given = {**trained_data, **given}
    merged = OmegaConf.create({**trained, "seed": config.seed, "data": given})
    return of_split(merged.data, config)


def of_split(data: DictConfig, config: DictConfig) -> DictConfig:
    """``data`` with evaluate's split and batch size.

    Raises ``InputError`` if the split is none with labels.
    """
    if config.split not in ("train", "val"):
        raise InputError(
            f"split={config.split}: labels exist for train and val (for images without labels: "
            "python -m occdetr.predict)"
        )
    with open_dict(data):
        data.update(
            eval_split=config.split,
            batch_size=config.batch_size,
            exchange_images=config.exchange_images,
        )
    return data


if __name__ == "__main__":
    main()
