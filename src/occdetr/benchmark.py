"""Size and speed of a network or of the data loaders: ``python -m occdetr.benchmark``.

``model=... device=auto|cpu|cuda`` measures the network, ``part=loader data=... data.root=...`` the
loaders that feed it.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from occdetr.classes import IGNORE
from occdetr.cli import entry as cli
from occdetr.data.datamodule import SceneDataModule
from occdetr.data.dataset import collate
from occdetr.errors import InputError
from occdetr.evaluation.speed import count_macs, measure_latency, measure_loading
from occdetr.files import write_json
from occdetr.structures import SceneBatch
from occdetr.training.device import choose_device, peak_memory_mb
from occdetr.training.precision import resolve_precision
from occdetr.training.trainer import seed_everything

PRECISIONS = ("auto", "32-true", "bf16-mixed")


@cli.entry_point("benchmark")
def main(config: DictConfig) -> None:
    """Measure, print a table, write ``benchmark.json`` into the run's folder."""
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
    """Parameters and multiply-adds; time and memory of a forward pass and of a training step."""
    device = choose_device(config.device)
    if config.precision not in PRECISIONS:
        known = ", ".join(PRECISIONS)
        raise InputError(f"precision={config.precision}: choose one of {known}")
    precision = resolve_precision(config.precision, device.type)
    autocast = torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16-mixed")
    config.model.backbone.weights = None
    model = cli.build(config.model).to(device).eval()
    batch = scene_batch(config)
    scene = scene_facts(batch)
    batch = batch.to(device)
    report: dict[str, Any] = {
        "part": "model",
        **_common_facts(config),
        "precision": precision,
        "scene": scene,
        "device": _device_name(device),
        "threads": torch.get_num_threads() if device.type == "cpu" else None,
        "params": sum(parameter.numel() for parameter in model.parameters()),
        "macs": count_macs(model, batch) // config.batch_size,
    }
    report |= _measure(autocast(lambda: model.predict(batch)), device, config, "forward")
    if config.backward:
        module = cli.build(config.module, model=model).to(device).train()

        def step() -> None:
            module.zero_grad()
            with autocast:  # without the backward pass, as in training
                loss = module.training_step(batch, 0)
            loss.backward()

        training = _measure(step, device, config, "training step")
        report |= {f"training_{key}": value for key, value in training.items()}
    return report, _model_table(report)


def scene_batch(config: DictConfig) -> SceneBatch:
    """``batch_size`` times one synthetic street, the same in every run.

    Its files are left in the run's folder.
    """
    datamodule: SceneDataModule = cli.build(config.scene, root=str(cli.run_folder() / "scene"))
    datamodule.prepare_data()
    return collate([datamodule.dataset("train")[0]] * config.batch_size)


def scene_facts(batch: SceneBatch) -> dict[str, Any]:
    """What a training step has to learn from the first frame."""
    assert batch.labels is not None
    assert batch.targets is not None
    labels = batch.labels[0]
    occupied = (labels != 0) & (labels != IGNORE)
    return {"occupied_voxels": int(occupied.sum()), "objects": len(batch.targets[0])}


def _common_facts(config: DictConfig) -> dict[str, Any]:
    return {
        "model": config.model_name,
        "partition": config.partition_name,
        "image_size": list(config.image_size),
        "batch_size": config.batch_size,
        "torch": torch.__version__,
    }


def _measure(
    function: Callable[[], Any], device: torch.device, config: DictConfig, description: str
) -> dict[str, Any]:
    """Latency, and peak memory in MiB: of these calls on a GPU, of the whole process on a CPU."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    latency = measure_latency(
        function,
        device,
        repeats=config.repeats,
        warmup=config.warmup,
        description=description,
    )
    return {**latency, "peak_memory_mb": round(peak_memory_mb(device), 1)}


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
    table.add_row("multiply-adds per image", f"{report['macs'] / 1e9:.2f} G")
    scene = report["scene"]
    table.add_row("street, occupied voxels", f"{scene['occupied_voxels']:,}")
    table.add_row("street, objects", f"{scene['objects']}")
    for prefix, name in (("", "forward"), ("training_", "training step")):
        if f"{prefix}latency_ms" not in report:
            continue
        low, high = report[f"{prefix}latency_ms_quartiles"]
        median = report[f"{prefix}latency_ms"]
        table.add_row(f"{name}, median (quartiles)", f"{median:.1f} ({low:.1f}-{high:.1f}) ms")
        table.add_row(f"{name}, peak memory", f"{report[f'{prefix}peak_memory_mb']:.0f} MiB")
    return table


def measure_loaders(config: DictConfig) -> tuple[dict[str, Any], Table]:
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
        **_common_facts(config),
        "workers": datamodule.loading.num_workers,
        "root": str(datamodule.root),
        "frames": len(datamodule.frames("train")),
        "plain": plain,
        "augmented": augmented,
    }
    return report, _loader_table(report)


def _loader_table(report: dict[str, Any]) -> Table:
    height, width = report["image_size"]
    size = f"{height} x {width}, batch {report['batch_size']}, workers {report['workers']}"
    table = Table(title=f"{report['frames']} frames, {size}")
    table.add_column("samples per second and worker")
    table.add_column("median (quartiles)", justify="right")
    for name, row in (("plain", "without augmentation"), ("augmented", "with augmentation")):
        median = report[name]["samples_per_second_per_worker"]
        low, high = report[name]["quartiles"]
        table.add_row(row, f"{median:.1f} ({low:.1f}-{high:.1f})")
    return table


if __name__ == "__main__":
    main()
