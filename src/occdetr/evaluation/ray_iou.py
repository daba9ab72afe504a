"""RayIoU: the IoU of what rays hit first, by class and within a distance.

Liu et al., Fully Sparse 3D Occupancy Prediction (SparseOcc), 2024. IoU of voxels rewards thick
surfaces, since a surface that is off by its thickness counts as all wrong. Rays see only the first
surface, and may be off by a tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics import Metric

from occdetr.classes import CLASS_NAMES, IGNORE, NUM_CLASSES
from occdetr.geometry.raycast import cast_rays
from occdetr.geometry.voxels import VOXEL_SIZE, metres_to_voxels

TOLERANCES = (1.0, 2.0, 4.0)  # metres
_LOWEST = 10  # rows of rays that meet flat ground 1, 2, ... 10 heights ahead
_HIGHEST = 0.21  # radians
_AZIMUTHS = 360


def lidar_directions() -> Float[NDArray, "ray 3"]:
    """SparseOcc's rays: one for each degree around, in rows like those of a LiDAR.

    The lowest ten rows would meet flat ground 1, 2, ... 10 times the height of the LiDAR away; from
    there rows follow at the last step up to 0.21 rad, the last one beyond it.
    """
    pitch = [-math.atan(1 / (row + 1)) for row in range(_LOWEST)]
    while pitch[-1] < _HIGHEST:
        pitch.append(2 * pitch[-1] - pitch[-2])
    up, around = np.meshgrid(pitch, np.radians(np.arange(_AZIMUTHS)), indexing="ij")
    rays = [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]
    return np.stack(rays, axis=-1).reshape(-1, 3)


class RayIoU(Metric):
    """RayIoU over all frames of all ranks, for SemanticKITTI's grid.

    Rays start at ``origins`` (metres in the grid frame; SparseOcc has up to eight along the
    vehicle's way, here by default one, the LiDAR). Only rays count that hit something in the truth;
    voxels whose truth is 255 stop no ray. A ray's prediction is right if its class is, and if the
    distances at which the rays enter the voxels differ by less than a tolerance.

    Examples:
        >>> import torch
        >>> from occdetr.evaluation.ray_iou import RayIoU
        >>> target = torch.zeros(1, 256, 256, 32, dtype=torch.uint8)
        >>> target[:, 100] = 13  # a wall 20 m ahead
        >>> metric = RayIoU()
        >>> metric.update(target.roll(7, dims=1), target)  # 1.4 m too far
        >>> scores = metric.compute()
        >>> scores["RayIoU@1"], scores["RayIoU@2"]
        (0.0, 1.0)
    """

    full_state_update = False
    hits: Tensor
    predicted: Tensor
    true: Tensor
    num_frames: Tensor

    def __init__(self, origins: Sequence[Sequence[float]] = ((0.0, 0.0, 0.0),)) -> None:
        super().__init__()
        directions = lidar_directions()
        starts = metres_to_voxels(np.asarray(origins, dtype=np.float64).reshape(-1, 3))
        self.starts = np.repeat(starts, len(directions), axis=0)
        self.directions = np.tile(directions, (len(starts), 1))
        zeros = torch.zeros(NUM_CLASSES, dtype=torch.int64)
        self.add_state("hits", torch.zeros(len(TOLERANCES), NUM_CLASSES, dtype=torch.int64), "sum")
        self.add_state("predicted", zeros, "sum")
        self.add_state("true", zeros.clone(), "sum")
        self.add_state("num_frames", torch.zeros((), dtype=torch.int64), "sum")

    def update(
        self, prediction: UInt8[Tensor, "batch x y z"], target: UInt8[Tensor, "batch x y z"]
    ) -> None:
        """Count a batch: ``prediction`` 0-19, ``target`` 0-19 or 255 (not evaluated)."""
        for found, truth in zip(prediction.cpu().numpy(), target.cpu().numpy(), strict=True):
            unknown = truth == IGNORE
            own, far = self._cast(np.where(unknown, 0, truth).astype(np.uint8))
            other, other_far = self._cast(np.where(unknown, 0, found).astype(np.uint8))
            valid = own > 0
            own, other = own[valid], other[valid]
            error = np.abs(far[valid] - other_far[valid]) * VOXEL_SIZE
            self.true += self._count(own)
            self.predicted += self._count(other)
            same = own == other
            for index, tolerance in enumerate(TOLERANCES):
                self.hits[index] += self._count(own[same & (error < tolerance)])
            self.num_frames += 1

    def _cast(
        self, grid: UInt8[NDArray, "x y z"]
    ) -> tuple[Int[NDArray, " ray"], Float[NDArray, " ray"]]:
        """The class that each ray hits, 0 if none, and the distance in voxels."""
        voxels, distances, _ = cast_rays(grid, self.starts, self.directions)
        classes = grid[tuple(voxels.T)].astype(np.int64)  # at (-1, -1, -1) without a hit
        return np.where(voxels[:, 0] >= 0, classes, 0), distances

    def _count(self, classes: Int[NDArray, " ray"]) -> Int[Tensor, " class"]:
        counts = np.bincount(classes, minlength=NUM_CLASSES)
        return torch.from_numpy(counts).to(self.true.device)

    def compute(self) -> dict[str, Any]:
        """``RayIoU``: the mean over tolerances and classes that occur in truth or prediction, as
        SparseOcc takes it; ``RayIoU@1``, ``@2``, ``@4``: of one tolerance in metres; ``per_class``:
        the mean over the tolerances by class name, None for a class that does not occur;
        ``num_frames``.
        """
        hits, union = self.hits.cpu().numpy()[:, 1:], (self.true + self.predicted).cpu().numpy()[1:]
        occurs = union > 0
        iou = hits[:, occurs] / (union - hits)[:, occurs]
        means = iou.mean(axis=1) if occurs.any() else np.zeros(len(TOLERANCES))
        by_class = dict.fromkeys(CLASS_NAMES[1:])
        names = np.array(CLASS_NAMES[1:])[occurs].tolist()
        by_class |= dict(zip(names, iou.mean(axis=0).tolist(), strict=True))
        named = {
            f"RayIoU@{tolerance:g}": float(mean)
            for tolerance, mean in zip(TOLERANCES, means, strict=True)
        }
        return {
            "RayIoU": float(means.mean()),
            **named,
            "per_class": by_class,
            "num_frames": int(self.num_frames),
        }
