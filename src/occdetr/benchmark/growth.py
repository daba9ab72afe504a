"""``part=scaling``: how time, multiply-adds and memory grow with the work."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from omegaconf import DictConfig, open_dict

from occdetr.benchmark.growth_plot import draw_growth
from occdetr.benchmark.sheet import Sheet
from occdetr.benchmark.sheets import curves_sheet
from occdetr.benchmark.subject import Machine, build_network, common_facts, street_batch
from occdetr.benchmark.work import exponent, last_exponent, no_worse_than_linear, with_objects
from occdetr.cli import entry as cli
from occdetr.errors import BATCH, InputError, check_each
from occdetr.evaluation.memory import tensor_memory_mb
from occdetr.evaluation.parts import frozen
from occdetr.evaluation.speed import macs_of, measure_latency
from occdetr.files import write_atomically
from occdetr.geometry.camera import check_image_size

TIME = "latency"
UNITS = {
    "slots": "slots",
    "kept": "kept cells, all layers",
    "image": "pixels",
    "batch": "images",
    "objects": "objects drawn (fusion alone)",
}
COUNTS = ("slots", "batch", "objects")  # others are factors


def measure_growth(config: DictConfig) -> tuple[dict[str, Any], Sheet]:
    """A curve for each name of ``config.scaling``; ``scaling.png`` shows them.

    Raises ``InputError`` for values that the network cannot have.
    """
    machine = Machine.chosen(config)
    with open_dict(config):  # the streets are written once, the network's image is resized
        config.scene.street_image_size = list(config.image_size)
    _check_values(config)
    curves = {name: _curve(name, config, machine) for name in config.scaling}
    report = {"part": "scaling", **common_facts(config), **machine.facts(), "curves": curves}
    sheet = curves_sheet(report)
    write_atomically(cli.run_folder() / "scaling.png", draw_growth(curves, sheet.title))
    return report, sheet


def _check_values(config: DictConfig) -> None:
    for name, values in config.scaling.items():
        if name not in UNITS:
            raise InputError(f"scaling.{name}: choose names of {', '.join(UNITS)}")
        _check_numbers(name, list(values))
        if name in ("slots", "objects") and config.model.detector is None:
            raise InputError(
                f"scaling.{name}: partition={config.partition_name} has no objects: "
                f"leave it out with ~scaling.{name}"
            )
        if name != "objects":
            _check_work(name, config)


def _check_numbers(name: str, values: list[float]) -> None:
    setting = f"scaling.{name}={values}"
    finite = all(0 < value < math.inf for value in values)
    if len(values) < 2 or values != sorted(set(values)) or not finite:
        raise InputError(f"{setting}: give two positive numbers or more, in order")
    if name in COUNTS and any(value % 1 for value in values):
        raise InputError(f"{setting}: give whole numbers")
    if name in ("batch", "objects"):
        check_each(f"scaling.{name}", values, BATCH)


def _check_work(name: str, config: DictConfig) -> None:
    """Raises ``InputError`` for an image that is too large, and unless the work grows from value to
    value: factors are rounded, and no more cells are kept than there are."""
    setting = f"scaling.{name}={list(config.scaling[name])}"
    points, work = zip(*(changed(config, name, each) for each in config.scaling[name]), strict=True)
    for point in points:
        check_image_size(f"{setting}: image_size", point.image_size)
    if list(work) != sorted(set(work)):
        raise InputError(f"{setting}: come to {list(work)} {UNITS[name]}: give others")


def _curve(name: str, config: DictConfig, machine: Machine) -> dict[str, Any]:
    points = _objects if name == "objects" else _networks
    values = list(config.scaling[name])
    work: list[float] = []
    costs: dict[str, list[float]] = {TIME: [], "multiply-adds": [], "memory": []}
    rounds = {"repeats": config.repeats, "warmup": config.warmup}
    for amount, model, call in points(name, values, config, machine):
        work.append(amount)
        latency = measure_latency(call, machine.device, **rounds, description=f"{name} {amount}")
        costs[TIME].append(latency["latency_ms"])
        with frozen(model):
            costs["multiply-adds"].append(macs_of(call))
        costs["memory"].append(round(tensor_memory_mb(call, machine.device), 3))
    fits = {
        cost: {
            "exponent": round(exponent(work, values), 3),
            "last": round(last_exponent(work, values), 3),
            "no_worse_than_linear": no_worse_than_linear(work, values),
        }
        for cost, values in costs.items()
    }
    return {"unit": UNITS[name], "work": work, "costs": costs, "fits": fits}


Point = tuple[float, torch.nn.Module, Callable[[], Any]]


def _networks(
    name: str, values: list[float], config: DictConfig, machine: Machine
) -> Iterator[Point]:
    """The amount of work of each value, the network, and its prediction."""
    for value in values:
        point, amount = changed(config, name, value)
        model = build_network(point, machine)
        batch = street_batch(point).to(machine.device)
        yield amount, model, machine.autocast()(lambda m=model, b=batch: m.predict(b))


def _objects(
    name: str, values: list[float], config: DictConfig, machine: Machine
) -> Iterator[Point]:
    """The fusion of one output with more and more objects."""
    point, _ = changed(config, "slots", max(values))
    model = build_network(point, machine)
    batch = street_batch(point).to(machine.device)
    with torch.no_grad(), machine.autocast():
        occupancy = model(batch.images, batch.camera).occupancy
    for value in values:
        output = with_objects(occupancy, int(value))
        yield value, model, torch.no_grad()(lambda o=output: model.fusion(o))


def changed(config: DictConfig, name: str, value: float) -> tuple[DictConfig, float]:
    """The settings with one of them changed, and the amount of work that this is."""
    point = config.copy()
    model = point.model
    if name == "slots":
        model.slots.num_slots = int(value)
        selection, most = model.detector.selection, max(config.scaling.get(name) or [value])
        selection.num_queries = max(selection.num_queries, int(most))
        return point, int(value)
    if name == "kept":
        background = model.occupancy_decoder.background
        if background is None:
            raise InputError(
                f"scaling.kept: partition={config.partition_name} has no background: "
                "leave it out with ~scaling.kept"
            )
        cells, kept = math.prod(background.grid), []
        for own in background.kept:
            cells = min(max(round(own * value), 1), 8 * cells)
            kept.append(cells)
        background.kept = kept
        return point, sum(kept)
    if name == "image":
        point.image_size = [max(round(side * value), 32) for side in config.image_size]
        return point, math.prod(point.image_size)
    point.batch_size = int(value)
    return point, int(value)
