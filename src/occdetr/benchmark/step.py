"""``part=model mode=train``: a training step, phase by phase."""

from __future__ import annotations

from typing import Any

import torch
from omegaconf import DictConfig

from occdetr.benchmark.sheet import Sheet
from occdetr.benchmark.sheets import steps_sheet
from occdetr.benchmark.subject import (
    Machine,
    build_network,
    check_threads,
    common_facts,
    cost_facts,
    streets,
)
from occdetr.cli import entry as cli
from occdetr.data.dataset import collate
from occdetr.evaluation.limits import measure_limits
from occdetr.evaluation.parts import parts_of
from occdetr.evaluation.speed import summary
from occdetr.models.backbone import batch_norms
from occdetr.training.device import peak_memory_mb
from occdetr.training.step_speed import (
    LOADING,
    STEP,
    count_step,
    loader_seconds,
    time_steps,
)


def measure_step(config: DictConfig) -> tuple[dict[str, Any], Sheet]:
    """Loader, forward pass, losses, backward pass, clipping, optimizer and memory of a step on
    synthetic streets, as Lightning runs it."""
    machine = Machine.chosen(config)
    device = machine.device
    model = build_network(config, machine).train()
    _give_statistics(model)
    module = cli.build(config.module, model=model)
    datamodule = streets(config, num_train=config.streets, batch_size=config.batch_size)
    index = device.index
    trainer = cli.build(
        config.trainer,
        _partial_=True,
        accelerator=device.type,
        devices=1 if index is None else [index],
        precision=machine.precision,
    )
    cpu_seconds = loader_seconds(datamodule, samples=max(config.repeats, 2))
    steps = max(config.repeats, 2) + config.warmup
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    timed, cpu_per_wall = time_steps(module, datamodule, trainer, device, cli.run_folder(), steps)
    timed = timed[config.warmup :]
    peak = peak_memory_mb(device)  # before the measurements that follow
    frames = datamodule.dataset("train")
    batch = collate([frames[i % len(frames)] for i in range(config.batch_size)]).to(device)
    module.to(device)
    with machine.autocast():
        costs = count_step(module, batch, config.trainer.gradient_clip_val)
    limits = measure_limits(device, machine.dtype)
    times = {name: summary([step[name] for step in timed]) for name in timed[0]}
    report = {
        "part": "model",
        "mode": "train",
        "stage": config.stage_name,
        **common_facts(config),
        **machine.facts(),
        **times[STEP],
        "cpu_per_wall": round(cpu_per_wall, 3),
        "peak_memory_mb": round(peak, 1),
        "limits": vars(limits),
        "loader": {
            "cpu_ms_per_sample": round(1000 * cpu_seconds, 2),
            "workers": datamodule.loading.num_workers,
            "hidden": _hidden(times[LOADING]["latency_ms"], cpu_seconds * config.batch_size),
        },
        "parts": list(parts_of(model)),
        "phases": {
            name: cost_facts(costs.get(name), latency, limits) for name, latency in times.items()
        },
    }
    check_threads(machine, cpu_per_wall)
    return report, steps_sheet(report)


def _give_statistics(model: torch.nn.Module) -> None:
    """What a stage may freeze: random weights have none."""
    for norm in batch_norms(model.get_submodule("backbone")):
        if norm.running_mean is not None:
            norm.running_mean.fill_(0.01)


def _hidden(waiting_ms: float, seconds: float) -> float:
    """The share of the loader's time for a batch that the steps do not wait for."""
    return round(min(max(1 - waiting_ms / (1000 * seconds), 0.0), 1.0), 3)
