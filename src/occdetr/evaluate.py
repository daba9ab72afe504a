"""Measure a checkpoint: ``python -m occdetr.evaluate checkpoint=... [data=... split=val]``."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from occdetr import cli
from occdetr.classes import CLASS_NAMES
from occdetr.data.semantickitti import write_labels
from occdetr.errors import InputError
from occdetr.oracle import LOSSES, Oracle
from occdetr.structures import SceneBatch
from occdetr.training.evaluation import EvaluationModule
from occdetr.training.trainer import is_main_process, make_trainer, run, seed_everything

FIGURES = {
    "mIoU": "mIoU (19 classes)",
    "mIoU_present": "mIoU (classes present)",
    "IoU": "IoU (occupied)",
    "precision": "precision (occupied)",
    "recall": "recall (occupied)",
    "AP50": "AP50 (2D boxes)",
    "mAP": "mAP (2D boxes)",
    "recall3d_25": "recall (3D boxes, IoU 0.25)",
}


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
    """Print a table and leave ``metrics.json`` (and the predictions) in the run's folder."""
    seed_everything(config.seed)
    set_threads(config.threads)
    refuse_another_network(config)
    if config.oracle:
        measure_ceilings(config)
        return
    path = Path(cli.required(config, "checkpoint", "outputs/full/<run>/best.ckpt"))
    model, trained, checkpoint = cli.restore_model(path)
    datamodule = cli.build(evaluation_data(config, trained))
    folder = cli.run_folder()
    write = PredictionWriter(folder / "predictions") if config.save_predictions else None
    module = EvaluationModule(model, write)
    trainer = make_trainer(folder, cli.plain(config.trainer))
    if is_main_process():
        datamodule.prepare_data()
        print(f"{cli.shown(path)} ({checkpoint.stage}) on {datamodule.summary(config.split)}")
    run(trainer, trainer.test, module, datamodule=datamodule, verbose=False)
    if not trainer.is_global_zero:
        return
    metrics = {
        **module.results,
        "checkpoint": str(path),
        "data": datamodule.summary(config.split),
        "split": config.split,
        "exchange_images": config.exchange_images,
    }
    cli.write_json(folder / "metrics.json", metrics)
    print_table(metrics)
    if config.exchange_images:
        print("note: every frame had the picture of another one")
    if checkpoint.stage == "pretrain":
        print("note: pretraining trains detection only, so the voxels are those of chance")
    saved = f", predictions in {cli.shown(folder / 'predictions')}" if write else ""
    print(f"done: {metrics['num_frames']} frames, {cli.shown(folder / 'metrics.json')}{saved}")


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
    oracle = Oracle(model, cli.build(trained.occupancy_criterion))
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
    cli.write_json(folder / "oracle.json", report)
    print_ceilings(report)
    print(f"done: {report['num_frames']} frames, {cli.shown(folder / 'oracle.json')}")


#: Settings of evaluate alone; all others say what the oracle's network and data are.
OWN_SETTINGS = (
    "checkpoint", "oracle", "split", "save_predictions", "exchange_images", "batch_size",
    "threads", "outputs", "trainer", "hydra",
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
    given: Any = OmegaConf.to_container(config.data)
    if "_target_" not in given:
        changed = {key: value for key, value in given.items() if value is not None}
        trained_data: Any = OmegaConf.to_container(trained.data)
        given = {**trained_data, **changed}
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


def print_ceilings(report: dict[str, Any]) -> None:
    """Ceilings in percent: a column for each loss alone, and for all of them together."""
    title = f"{report['model']}, {report['partition']}: {report['num_frames']} frames, in %"
    table = Table(title=title)
    variants = report["variants"]
    table.add_column(no_wrap=True)
    for name in variants:
        table.add_column(name, justify="right")
    figures = {"mIoU_present": "mIoU, present", "mIoU": "mIoU", "IoU": "SC IoU"}
    for key, name in figures.items():
        table.add_row(name, *[f"{100 * v[key]:.2f}" for v in variants.values()])
    table.add_section()
    for name in CLASS_NAMES[1:]:
        table.add_row(name, *[f"{100 * v['per_class'][name]:.2f}" for v in variants.values()])
    console = Console()
    console.print(table)
    for name, meaning in LOSSES.items():
        console.print(f"{name}: {meaning}")


def print_table(metrics: dict[str, Any]) -> None:
    """All figures and the IoU of each class, in percent."""
    table = Table(title=f"{metrics['num_frames']} frames, split {metrics['split']}, in %")
    table.add_column("")
    table.add_column("", justify="right")
    for key, name in FIGURES.items():
        table.add_row(name, f"{100 * metrics[key]:.2f}")
    table.add_section()
    for name in CLASS_NAMES[1:]:
        table.add_row(name, f"{100 * metrics['per_class'][name]:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
