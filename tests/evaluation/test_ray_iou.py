"""RayIoU against a slow computation, and what it forgives."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from occdetr.evaluation.ray_iou import TOLERANCES, RayIoU, lidar_directions
from occdetr.geometry.voxels import GRID_SHAPE, VOXEL_SIZE, metres_to_voxels


def first_hits(grid: NDArray, origin: NDArray) -> tuple[NDArray, NDArray]:
    """Class and distance (metres) of the nearest voxel that each ray meets: every ray is cut with
    every occupied voxel."""
    directions = lidar_directions()
    start = metres_to_voxels(origin)
    best, classes = np.full(len(directions), np.inf), np.zeros(len(directions), int)
    with np.errstate(divide="ignore", invalid="ignore"):
        for voxel in np.argwhere(grid):
            ends = np.stack([(voxel - start) / directions, (voxel + 1 - start) / directions])
            enter, leave = ends.min(0).max(1), ends.max(0).min(1)
            nearer = (enter < leave) & (leave > 0) & (np.maximum(enter, 0) < best)
            best = np.where(nearer, np.maximum(enter, 0), best)
            classes = np.where(nearer, grid[tuple(voxel)], classes)
    return classes, best * VOXEL_SIZE


def reference(pairs: list[tuple[NDArray, NDArray]], origins: list[NDArray]) -> dict[str, float]:
    true, predicted, hits = np.zeros(20), np.zeros(20), np.zeros((3, 20))
    for prediction, target in pairs:
        known = target != 255
        for origin in origins:
            own, far = first_hits(np.where(known, target, 0), origin)
            other, other_far = first_hits(np.where(known, prediction, 0), origin)
            for a, d, b, e in zip(own, far, other, other_far, strict=True):
                if a == 0:
                    continue
                true[a] += 1
                predicted[b] += 1
                for index, tolerance in enumerate(TOLERANCES):
                    hits[index, a] += a == b and abs(d - e) < tolerance
    predicted[0] = true[0] = 0
    with np.errstate(invalid="ignore"):
        iou = (hits / (true + predicted - hits))[:, 1:]
    means = np.nanmean(iou, axis=1)
    return {"RayIoU": means.mean(), **dict(zip(["1", "2", "4"], means, strict=True))}


def scattered(seed: int, number: int) -> NDArray[np.uint8]:
    """Blocks of a few voxels near the LiDAR, which many rays meet."""
    rng = np.random.default_rng(seed)
    grid = np.zeros(GRID_SHAPE, np.uint8)
    for _ in range(number):
        x, y, z = rng.integers((4, 100, 4), (40, 150, 14))
        grid[x : x + 2, y : y + 3, z : z + 3] = rng.integers(1, 6)
    return grid


def test_it_equals_a_slow_computation() -> None:
    target = scattered(0, 14)
    prediction = np.roll(target, 7, axis=0)
    prediction[:, 120:128] = np.where(prediction[:, 120:128] > 0, 9, 0)
    target[20:24, 110:140] = 255
    origins = [np.zeros(3), np.array([1.5, 0.4, 0.2])]
    metric = RayIoU(origins=[origin.tolist() for origin in origins])
    for found, truth in ((prediction, target), (scattered(2, 10), target)):
        metric.update(torch.from_numpy(found)[None], torch.from_numpy(truth)[None])
    scores = metric.compute()
    expected = reference([(prediction, target), (scattered(2, 10), target)], origins)
    assert 0.005 < expected["1"] < expected["4"] < 1
    assert scores["RayIoU"] == pytest.approx(expected["RayIoU"], abs=1e-3)
    for name in ("1", "2", "4"):
        assert scores[f"RayIoU@{name}"] == pytest.approx(expected[name], abs=1e-3)
    assert scores["num_frames"] == 2


def test_a_thick_wall_gains_nothing_and_a_shifted_one_little() -> None:
    target = torch.zeros(1, *GRID_SHAPE, dtype=torch.uint8)
    target[:, 100:102] = 13
    thick = target.clone()
    thick[:, 100:140] = 13

    def score(prediction: torch.Tensor) -> dict:
        metric = RayIoU()
        metric.update(prediction, target)
        return metric.compute()

    assert score(target)["RayIoU"] == 1
    assert score(thick)["RayIoU"] == 1
    shifted = score(target.roll(8, dims=1))  # 1.6 m
    assert shifted["RayIoU@1"] == 0
    assert shifted["RayIoU@4"] > 0.85  # slanted rays are off by more
    assert score(torch.zeros_like(target))["RayIoU"] == 0
    assert score(target)["per_class"]["building"] == 1
    assert score(target)["per_class"]["car"] is None


def test_unknown_voxels_stop_no_ray() -> None:
    target = torch.zeros(1, *GRID_SHAPE, dtype=torch.uint8)
    target[:, 100] = 13
    prediction = target.clone()
    prediction[:, 50] = 15
    target[:, 50] = 255
    metric = RayIoU()
    metric.update(prediction, target)
    assert metric.compute()["RayIoU"] == 1


def test_rays_are_those_of_sparseocc() -> None:
    pitch = np.arcsin(lidar_directions()[::360, 2])
    np.testing.assert_allclose(pitch[:3], [-np.pi / 4, -np.arctan(1 / 2), -np.arctan(1 / 3)])
    np.testing.assert_allclose(np.diff(pitch[9:]), np.diff(pitch[8:10])[0])
    assert pitch[-2] < 0.21 <= pitch[-1]
