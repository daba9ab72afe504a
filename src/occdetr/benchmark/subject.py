"""What is measured: a network on a device, and a street that it looks at."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from typing import Any

import torch
from omegaconf import DictConfig

from occdetr.classes import IGNORE
from occdetr.cli import entry as cli
from occdetr.data.datamodule import SceneDataModule
from occdetr.data.dataset import collate
from occdetr.errors import InputError
from occdetr.evaluation.limits import DeviceLimits
from occdetr.evaluation.parts import Cost
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import SceneBatch
from occdetr.training.device import choose_device
from occdetr.training.precision import resolve_precision

PRECISIONS = ("auto", "32-true", "bf16-mixed")


@dataclass(frozen=True)
class Machine:
    """The device that computes, and in which precision: ``32-true`` or ``bf16-mixed``."""

    device: torch.device
    precision: str

    @classmethod
    def chosen(cls, config: DictConfig) -> Machine:
        """That of the settings. Raises ``InputError`` if there is none."""
        device = choose_device(config.device)
        if config.precision not in PRECISIONS:
            known = ", ".join(PRECISIONS)
            raise InputError(f"precision={config.precision}: choose one of {known}")
        return cls(device, resolve_precision(config.precision, device.type))

    @property
    def dtype(self) -> torch.dtype:
        """Of the matrix products."""
        return torch.bfloat16 if self.precision == "bf16-mixed" else torch.float32

    @property
    def threads(self) -> int | None:
        return torch.get_num_threads() if self.device.type == "cpu" else None

    def autocast(self) -> torch.autocast:
        mixed = self.precision == "bf16-mixed"
        return torch.autocast(self.device.type, torch.bfloat16, enabled=mixed)

    def facts(self) -> dict[str, Any]:
        """What a report says of the machine."""
        name = f"cpu ({platform.processor() or platform.machine()})"
        if self.device.type == "cuda":
            name = torch.cuda.get_device_name(self.device)
        return {"device": name, "precision": self.precision, "threads": self.threads}


def build_network(config: DictConfig, machine: Machine) -> OccupancyDETR:
    """The network of the settings, with random weights."""
    config.model.backbone.weights = None
    return cli.build(config.model).to(machine.device).eval()


def streets(config: DictConfig, **settings: Any) -> SceneDataModule:
    """The streets of the run's folder, the same in every run; written if they are missing."""
    root = str(cli.run_folder() / "scene")
    datamodule: SceneDataModule = cli.build(config.scene, root=root, **settings)
    datamodule.prepare_data()
    return datamodule


def street_batch(config: DictConfig) -> SceneBatch:
    """``batch_size`` times the first street."""
    return collate([streets(config).dataset("train")[0]] * config.batch_size)


def street_facts(batch: SceneBatch) -> dict[str, Any]:
    """What a training step has to learn from the first frame."""
    assert batch.labels is not None
    assert batch.targets is not None
    labels = batch.labels[0]
    occupied = (labels != 0) & (labels != IGNORE)
    return {"occupied_voxels": int(occupied.sum()), "objects": len(batch.targets[0])}


def common_facts(config: DictConfig) -> dict[str, Any]:
    """What every report says of its settings."""
    return {
        "model": config.model_name,
        "partition": config.partition_name,
        "image_size": list(config.image_size),
        "batch_size": config.batch_size,
        "torch": torch.__version__,
    }


def cost_facts(cost: Cost | None, latency: dict[str, Any], limits: DeviceLimits) -> dict[str, Any]:
    """A row of a report: what a computation takes, and how near to the limit of the device it is.

    ``least_bytes`` and with it ``share_of_limit`` are None where the bytes are not known (0).
    """
    if cost is None:
        return latency
    least = limits.least_seconds(cost.macs, cost.least_bytes)
    share = 1000 * least / latency["latency_ms"] if latency["latency_ms"] > 0 else 0.0
    return {
        "macs": cost.macs,
        "least_bytes": cost.least_bytes or None,
        "operator_bytes": cost.operator_bytes,
        **latency,
        "least_ms": round(1000 * least, 4),
        "share_of_limit": round(share, 4) if cost.least_bytes else None,
    }


def check_threads(machine: Machine, cpu_per_wall: float) -> None:
    """Warn if the threads did not compute all the time: the times are then those of other work."""
    threads = machine.threads
    if threads is not None and cpu_per_wall < 0.8 * threads:
        print(
            f"warning: CPU time is {cpu_per_wall:.2f} times the wall time with {threads} "
            "thread(s): the times are too long: end other work, or set OMP_PROC_BIND=close and "
            "OMP_NUM_THREADS to the number of free cores"
        )
