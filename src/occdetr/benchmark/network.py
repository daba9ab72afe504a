"""``part=model``: a prediction, part by part."""

from __future__ import annotations

from typing import Any

import torch
from omegaconf import DictConfig

from occdetr.benchmark.sheet import Sheet
from occdetr.benchmark.sheets import parts_sheet
from occdetr.benchmark.subject import (
    Machine,
    build_network,
    check_threads,
    common_facts,
    cost_facts,
    street_batch,
    street_facts,
)
from occdetr.evaluation.limits import measure_limits
from occdetr.evaluation.memory import tensor_memory_mb
from occdetr.evaluation.parts import WHOLE, count_parts, parts_of, time_parts
from occdetr.training.device import peak_memory_mb


def measure_network(config: DictConfig) -> tuple[dict[str, Any], Sheet]:
    """Parameters, multiply-adds, bytes, time and memory of a prediction."""
    machine = Machine.chosen(config)
    device = machine.device
    model = build_network(config, machine)
    batch = street_batch(config)
    scene, batch = street_facts(batch), batch.to(device)
    predict = machine.autocast()(lambda: model.predict(batch))
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    rounds = {"repeats": config.repeats, "warmup": config.warmup}
    times, cpu_per_wall = time_parts(model, predict, device, **rounds)
    peak = peak_memory_mb(device)  # before the measurements that follow
    with machine.autocast():
        costs = count_parts(model, batch)
    limits = measure_limits(device, machine.dtype)
    sizes = {name: _size(part) for name, part in parts_of(model).items()}
    sizes[WHOLE] = _size(model)
    report = {
        "part": "model",
        "mode": "predict",
        **common_facts(config),
        **machine.facts(),
        "scene": scene,
        "params": sizes[WHOLE],
        "macs": costs[WHOLE].macs // config.batch_size,
        **times[WHOLE],
        "cpu_per_wall": round(cpu_per_wall, 3),
        "peak_memory_mb": round(peak, 1),
        "tensor_memory_mb": round(tensor_memory_mb(predict, device), 1),
        "limits": vars(limits),
        "parts": {
            name: {"params": sizes.get(name), **cost_facts(costs.get(name), latency, limits)}
            for name, latency in times.items()
        },
    }
    check_threads(machine, cpu_per_wall)
    return report, parts_sheet(report)


def _size(part: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in part.parameters())
