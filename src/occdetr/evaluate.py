"""Measure a checkpoint: ``python -m occdetr.evaluate checkpoint=... [data=... split=val]``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from torch import Tensor

from occdetr import cli
from occdetr.classes import CLASS_NAMES
from occdetr.data.semantickitti import write_labels
from occdetr.errors import InputError
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
    metrics = {**module.results, "checkpoint": str(path), "split": config.split}
    cli.write_json(folder / "metrics.json", metrics)
    print_table(metrics)
    if checkpoint.stage == "pretrain":
        print("note: pretraining trains detection only, so the voxels are those of chance")
    saved = f", predictions in {cli.shown(folder / 'predictions')}" if write else ""
    print(f"done: {metrics['num_frames']} frames, {cli.shown(folder / 'metrics.json')}{saved}")


def set_threads(number: int) -> None:
    """Threads of this process and of the further ranks, for which Lightning would choose others."""
    os.environ["OMP_NUM_THREADS"] = str(number)
    torch.set_num_threads(number)


def evaluation_data(config: DictConfig, trained: DictConfig) -> DictConfig:
    """The data that ``config`` names, else the checkpoint's, for the checkpoint's network.

    Raises ``InputError`` if the split is none with labels.
    """
    if config.split not in ("train", "val"):
        raise InputError(
            f"split={config.split}: labels exist for train and val (for images without labels: "
            "python -m occdetr.predict)"
        )
    given: Any = OmegaConf.to_container(config.data)
    if "_target_" not in given:
        changed = {key: value for key, value in given.items() if value is not None}
        trained_data: Any = OmegaConf.to_container(trained.data)
        given = {**trained_data, **changed}
    merged = OmegaConf.create({**trained, "seed": config.seed, "data": given})
    merged.data.update(eval_split=config.split, batch_size=config.batch_size)
    return merged.data


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
