"""Size and speed of a model: ``python -m occdetr.benchmark model=... device=auto|cpu|cuda``.

And the speed of the loaders that feed it: ``part=loader model=... data=... data.root=...``.
"""

from __future__ import annotations

import itertools
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch.utils.data import DataLoader
from torch.utils.flop_counter import FlopCounterMode

from occdetr.cli import entry as cli
from occdetr.data.datamodule import SceneDataModule
from occdetr.errors import InputError
from occdetr.files import write_json
from occdetr.geometry.voxels import GRID_SHAPE
from occdetr.models.occdetr import OccupancyDETR
from occdetr.streets.moment import Camera
from occdetr.structures import SceneBatch, SceneTarget
from occdetr.training.device import choose_device, peak_memory_mb, resolve_precision
from occdetr.training.trainer import seed_everything

PRECISIONS = ("auto", "32-true", "bf16-mixed")


@cli.entry_point("benchmark")
def main(config: DictConfig) -> None:
    """Measure, print a table, write ``benchmark.json`` in the run's folder."""
    parts = {"model": measure_model, "loader": measure_loaders}
    if config.part not in parts:
        raise InputError(f"part={config.part}: choose one of {', '.join(parts)}")
    seed_everything(config.seed)
    report, table = parts[config.part](config)
    path = cli.run_folder() / "benchmark.json"
    write_json(path, report)
    Console().print(table)
    print(f"done: {cli.shown(path)}")


def measure_model(config: DictConfig) -> tuple[dict[str, Any], Table]:
    """Parameters, multiply-adds, time and memory of a forward pass, and of a training step."""
    device = choose_device(config.device)
    if config.precision not in PRECISIONS:
        known = ", ".join(PRECISIONS)
        raise InputError(f"precision={config.precision}: choose one of {known}")
    precision = resolve_precision(config.precision, device.type)
    mixed = torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16-mixed")
    config.model.backbone.weights = None
    model = cli.build(config.model).to(device).eval()
    batch = example_batch(config, device)
    report: dict[str, Any] = {
        "part": "model",
        "model": config.model_name,
        "partition": config.partition_name,
        "image_size": list(config.image_size),
        "batch_size": config.batch_size,
        "precision": precision,
        "device": _device_name(device),
        "threads": torch.get_num_threads() if device.type == "cpu" else None,
        "torch": torch.__version__,
        "params": sum(parameter.numel() for parameter in model.parameters()),
        "macs": count_macs(model, batch) // config.batch_size,
    }
    report |= measure(mixed(lambda: model.predict(batch)), config, device, "forward")
    if config.backward:
        module = cli.build(config.module, model=model).to(device).train()

        def step() -> None:
            module.zero_grad()
            with mixed:  # the backward pass stays outside, as in training
                loss = module.training_step(batch, 0)
            loss.backward()

        training = measure(step, config, device, "training step")
        report |= {f"training_{key}": value for key, value in training.items()}
    return report, _model_table(report)


def example_batch(config: DictConfig, device: torch.device) -> SceneBatch:
    """Noise through KITTI's camera, with empty labels and a few objects ahead of the car."""
    size, count = tuple(config.image_size), config.batch_size
    calibration = Camera(size).calibration
    classes = torch.tensor(list(config.foreground_classes[:4]), dtype=torch.long)
    number = len(classes)
    boxes3d = torch.tensor([[0.0, 1.0, 15.0, 2.0, 2.0, 4.0]]).repeat(number, 1)
    target = SceneTarget(
        classes=classes,
        boxes_cxcywh=torch.tensor([[0.5, 0.5, 0.1, 0.2]]).repeat(number, 1),
        boxes3d_camera=boxes3d,
        boxes3d_grid=boxes3d[:, [2, 0, 1, 5, 3, 4]],
        voxels=torch.zeros(0, 3, dtype=torch.int16),
        voxel_object=torch.zeros(0, dtype=torch.long),
        visible_fraction=torch.ones(number),
        roi_indices=torch.arange(number),
    )
    batch = SceneBatch(
        images=torch.randn(count, 3, *size),
        projection=torch.from_numpy(calibration.projection).float().repeat(count, 1, 1),
        lidar_to_camera=torch.from_numpy(calibration.lidar_to_camera).float().repeat(count, 1, 1),
        frame_indices=torch.arange(count),
        frame_ids=[f"{index:06d}" for index in range(count)],
        labels=torch.zeros(count, *GRID_SHAPE, dtype=torch.uint8),
        targets=[target] * count,
    )
    return batch.to(device)


def count_macs(model: OccupancyDETR, batch: SceneBatch) -> int:
    """Multiply-adds of all convolutions and matrix products in a forward pass."""
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    model.requires_grad_(False)  # the counter's hooks fail on parameters under no_grad
    with FlopCounterMode(display=False) as counter:
        model.predict(batch)
    for parameter in trained:
        parameter.requires_grad_(True)
    return counter.get_total_flops() // 2


def measure(
    function: Callable[[], Any], config: DictConfig, device: torch.device, name: str
) -> dict[str, Any]:
    """Milliseconds a call (median, and the quartiles as spread) and peak memory in MiB.

    On a GPU the peak is that of torch's allocator during these calls, on a CPU the most memory
    that the whole process has had.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    times = []
    rounds = range(-max(config.warmup, 1), max(config.repeats, 2))
    for number in track(rounds, description=name, transient=True):
        began = _now(device)
        function()
        elapsed = _now(device) - began
        if number >= 0:
            times.append(elapsed * 1000)
    low, median, high = statistics.quantiles(times, n=4, method="inclusive")
    return {
        "latency_ms": round(median, 3),
        "latency_ms_quartiles": [round(low, 3), round(high, 3)],
        "latency_ms_min": round(min(times), 3),
        "repeats": len(times),
        "peak_memory_mb": round(peak_memory_mb(device), 1),
    }


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"cpu ({platform.processor() or platform.machine()})"


def _model_table(report: dict[str, Any]) -> Table:
    height, width = report["image_size"]
    table = Table(title=f"{report['model']}, {height} x {width}, batch {report['batch_size']}")
    table.add_column(f"{report['device']}, {report['precision']}")
    table.add_column("", justify="right")
    table.add_row("parameters", f"{report['params'] / 1e6:.2f} M")
    table.add_row("multiply-adds an image", f"{report['macs'] / 1e9:.2f} G")
    for prefix, name in (("", "forward"), ("training_", "training step")):
        if f"{prefix}latency_ms" not in report:
            continue
        low, high = report[f"{prefix}latency_ms_quartiles"]
        median = report[f"{prefix}latency_ms"]
        table.add_row(f"{name}, median (quartiles)", f"{median:.1f} ({low:.1f}-{high:.1f}) ms")
        table.add_row(f"{name}, peak memory", f"{report[f'{prefix}peak_memory_mb']:.0f} MiB")
    return table


def measure_loaders(config: DictConfig) -> tuple[dict[str, Any], Table]:
    """Samples a second and worker of the training frames, without and with augmentation.

    Object labels that are missing are made first.
    """
    # the test loader gives the frames of eval_split as they are
    datamodule: SceneDataModule = cli.build(config.data, eval_split="train")
    datamodule.prepare_data()
    print(datamodule.summary("train"), flush=True)
    datamodule.prepare_objects(("train",), num_workers=max(datamodule.num_workers, 1))
    report: dict[str, Any] = {
        "part": "loader",
        "model": config.model_name,
        "partition": config.partition_name,
        "image_size": list(config.image_size),
        "batch_size": config.batch_size,
        "workers": datamodule.num_workers,
        "root": str(datamodule.root),
        "frames": len(datamodule.frames("train")),
        "torch": torch.__version__,
        "plain": measure_loader(datamodule.test_dataloader(), config, "as they are"),
        "augmented": measure_loader(datamodule.train_dataloader(), config, "augmented"),
    }
    return report, _loader_table(report)


def measure_loader(loader: DataLoader[Any], config: DictConfig, name: str) -> dict[str, Any]:
    """Samples a second and worker: median and quartiles of ``repeats`` stretches of ``samples``,
    after ``warmup`` more, and after each frame was read once if the set is no larger than that."""
    stream = _endless(loader)
    rates = []
    rounds = range(-max(config.warmup, 1), max(config.repeats, 2))
    for number in track(rounds, description=name, transient=True):
        began, samples = time.perf_counter(), 0
        while samples < config.samples:
            samples += len(next(stream))
        if number >= 0:
            rates.append(samples / (time.perf_counter() - began) / max(loader.num_workers, 1))
    low, median, high = statistics.quantiles(rates, n=4, method="inclusive")
    return {
        "samples_per_second_per_worker": round(median, 2),
        "quartiles": [round(low, 2), round(high, 2)],
        "samples": config.samples * len(rates),
    }


def _endless(loader: DataLoader[Any]) -> Iterator[SceneBatch]:
    """The batches of one epoch after the other, each with its own order and augmentation."""
    for epoch in itertools.count():
        loader.sampler.set_epoch(epoch)  # pyright: ignore[reportAttributeAccessIssue]
        yield from loader


def _loader_table(report: dict[str, Any]) -> Table:
    height, width = report["image_size"]
    size = f"{height} x {width}, batch {report['batch_size']}, workers {report['workers']}"
    table = Table(title=f"{report['frames']} frames, {size}")
    table.add_column("samples a second and worker")
    table.add_column("median (quartiles)", justify="right")
    for name, row in (("plain", "without augmentation"), ("augmented", "with augmentation")):
        median, (low, high) = (
            report[name]["samples_per_second_per_worker"],
            report[name]["quartiles"],
        )
        table.add_row(row, f"{median:.1f} ({low:.1f}-{high:.1f})")
    return table


if __name__ == "__main__":
    main()
