"""Size and speed: multiply-adds and latency of a network, samples per second of a data loader."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from rich.progress import track
from torch.utils.data import DataLoader
from torch.utils.flop_counter import FlopCounterMode

from occdetr.geometry.camera import Camera
from occdetr.geometry.kitti import kitti_camera
from occdetr.geometry.voxels import GRID_SHAPE
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import SceneBatch, SceneTarget


def example_batch(
    image_size: tuple[int, int], batch_size: int, classes: Sequence[int]
) -> SceneBatch:
    """Noise images with KITTI's camera, empty labels, and one object of each of ``classes``.

    ``image_size`` is (height, width) in pixels. All objects have the same box 15 m ahead.
    """
    count, camera = len(classes), kitti_camera(image_size)
    boxes3d = torch.tensor([[0.0, 1.0, 15.0, 2.0, 2.0, 4.0]]).repeat(count, 1)
    target = SceneTarget(
        classes=torch.tensor(list(classes), dtype=torch.long),
        boxes_cxcywh=torch.tensor([[0.5, 0.5, 0.1, 0.2]]).repeat(count, 1),
        boxes3d_camera=boxes3d,
        boxes3d_grid=boxes3d[:, [2, 0, 1, 5, 3, 4]],
        voxels=torch.zeros(0, 3, dtype=torch.int16),
        voxel_object=torch.zeros(0, dtype=torch.long),
        visible_fraction=torch.ones(count),
        roi_indices=torch.arange(count),
    )
    return SceneBatch(
        images=torch.randn(batch_size, 3, *image_size),
        camera=Camera(
            torch.as_tensor(camera.projection).float().repeat(batch_size, 1, 1),
            torch.as_tensor(camera.lidar_to_camera).float().repeat(batch_size, 1, 1),
            image_size,
        ),
        frame_indices=torch.arange(batch_size),
        frame_ids=[f"{index:06d}" for index in range(batch_size)],
        labels=torch.zeros(batch_size, *GRID_SHAPE, dtype=torch.uint8),
        targets=[target] * batch_size,
    )


def count_macs(model: OccupancyDETR, batch: SceneBatch) -> int:
    """Multiply-adds of all convolutions and matrix products in a forward pass over ``batch``."""
    trainable = [parameter for parameter in model.parameters() if parameter.requires_grad]
    model.requires_grad_(False)  # the counter's hooks fail on trainable parameters under no_grad
    with FlopCounterMode(display=False) as counter:
        model.predict(batch)
    for parameter in trainable:
        parameter.requires_grad_(True)
    return counter.get_total_flops() // 2


def measure_latency(
    function: Callable[[], Any],
    device: torch.device,
    *,
    repeats: int,
    warmup: int,
    description: str = "forward",
) -> dict[str, Any]:
    """Wall-clock time of ``function()`` in milliseconds: median, quartiles and minimum.

    It is called ``repeats`` times (at least 2) after ``warmup`` calls (at least 1) that are not
    counted. On a GPU the clock is read after all kernels have finished.
    """
    times = []
    rounds = range(-max(warmup, 1), max(repeats, 2))
    for number in track(rounds, description=description, transient=True):
        start = _synchronized_time(device)
        function()
        elapsed = _synchronized_time(device) - start
        if number >= 0:
            times.append(elapsed * 1000)
    low, median, high = statistics.quantiles(times, n=4, method="inclusive")
    return {
        "latency_ms": round(median, 3),
        "latency_ms_quartiles": [round(low, 3), round(high, 3)],
        "latency_ms_min": round(min(times), 3),
        "repeats": len(times),
    }


def _synchronized_time(device: torch.device) -> float:
    """The clock in seconds, after all work on ``device`` has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def measure_loading(
    loader: DataLoader[Any], *, samples: int, repeats: int, warmup: int, description: str
) -> dict[str, Any]:
    """Samples per second and worker of a loader: median and quartiles.

    Each of ``repeats`` rounds (at least 2), after ``warmup`` rounds (at least 1) that are not
    counted, reads ``samples`` samples. With ``warmup`` * ``samples`` at least as large as the data
    set every frame has been read once before the measurement. The loader's sampler must have
    ``set_epoch``.
    """
    batches = _endless(loader)
    rates = []
    rounds = range(-max(warmup, 1), max(repeats, 2))
    for number in track(rounds, description=description, transient=True):
        start, count = time.perf_counter(), 0
        while count < samples:
            count += len(next(batches))
        if number >= 0:
            elapsed = time.perf_counter() - start
            rates.append(count / elapsed / max(loader.num_workers, 1))
    low, median, high = statistics.quantiles(rates, n=4, method="inclusive")
    return {
        "samples_per_second_per_worker": round(median, 2),
        "quartiles": [round(low, 2), round(high, 2)],
        "samples": samples * len(rates),
    }


def _endless(loader: DataLoader[Any]) -> Iterator[SceneBatch]:
    """The batches of one epoch after the other, each epoch with its own order and augmentation."""
    for epoch in itertools.count():
        loader.sampler.set_epoch(epoch)  # pyright: ignore[reportAttributeAccessIssue]
        yield from loader
