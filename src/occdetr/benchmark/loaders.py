"""``part=loader``: how fast the training frames are read."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from occdetr.benchmark.sheet import Sheet
from occdetr.benchmark.sheets import loader_sheet
from occdetr.benchmark.subject import common_facts
from occdetr.cli import entry as cli
from occdetr.data.datamodule import SceneDataModule
from occdetr.evaluation.speed import measure_loading


def measure_loaders(config: DictConfig) -> tuple[dict[str, Any], Sheet]:
    """Samples per second and worker of the training frames, without and with augmentation.

    Object labels that are missing are made first.
    """
    # eval_split makes the test loader read the training frames, without augmentation
    datamodule: SceneDataModule = cli.build(config.data, eval_split="train")
    datamodule.prepare_data()
    print(datamodule.summary("train"), flush=True)
    datamodule.prepare_objects(("train",), num_workers=max(datamodule.loading.num_workers, 1))
    rounds = {key: config[key] for key in ("samples", "repeats", "warmup")}
    plain = measure_loading(datamodule.test_dataloader(), **rounds, description="plain")
    augmented = measure_loading(datamodule.train_dataloader(), **rounds, description="augmented")
    report: dict[str, Any] = {
        "part": "loader",
        **common_facts(config),
        "workers": datamodule.loading.num_workers,
        "root": str(datamodule.root),
        "frames": len(datamodule.frames("train")),
        "plain": plain,
        "augmented": augmented,
    }
    return report, loader_sheet(report)
