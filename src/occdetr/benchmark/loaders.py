"""``part=loader``: how fast the training frames are read."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from occdetr.benchmark.sheet import Sheet
from occdetr.benchmark.sheets import loader_sheet
from occdetr.benchmark.subject import common_facts
from occdetr.cli import entry as cli
from occdetr.data.augment import Augmentation
from occdetr.data.datamodule import SceneDataModule
from occdetr.evaluation.speed import measure_loading


def measure_loaders(config: DictConfig) -> tuple[dict[str, Any], Sheet]:
    """Samples per second and worker of the training frames, without and with augmentation.

    Object labels that are missing are made first.
    """
    datamodule: SceneDataModule = cli.build(config.data)
    datamodule.prepare_data()
    print(datamodule.training_summary(), flush=True)
    datamodule.prepare_objects(("train",), num_workers=max(datamodule.loading.num_workers, 1))
    rounds = {key: config[key] for key in ("samples", "repeats", "warmup")}
    augmented = measure_loading(datamodule.train_dataloader(), **rounds, description="augmented")
    datamodule.augmentation = Augmentation()
    plain = measure_loading(datamodule.train_dataloader(), **rounds, description="plain")
    report: dict[str, Any] = {
        "part": "loader",
        **common_facts(config),
        "workers": datamodule.loading.num_workers,
        "root": str(datamodule.root),
        "frames": len(datamodule.training_frames()),
        "plain": plain,
        "augmented": augmented,
    }
    return report, loader_sheet(report)
