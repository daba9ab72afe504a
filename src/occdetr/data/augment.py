"""Augmentation that keeps picture, camera, boxes and grid true to each other."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from occdetr.data.objects import SceneObjects
from occdetr.data.semantickitti import Calibration
from occdetr.geometry.voxels import GRID_SHAPE

_MIRROR_X = np.diag([-1.0, 1.0, 1.0, 1.0])
_MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def flip_calibration(calibration: Calibration, width: int) -> Calibration:
    """The camera of the mirrored world: it sees the point (x, -y, z) of the grid frame at the pixel
    (width - 1 - u, v), where the given camera sees (x, y, z) at (u, v).

    The camera axis x turns round with the picture, so both matrices change, P2's fourth column too.
    """
    mirror_u = np.array([[-1.0, 0.0, width - 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return Calibration(
        projection=mirror_u @ calibration.projection @ _MIRROR_X,
        lidar_to_camera=_MIRROR_X @ calibration.lidar_to_camera @ _MIRROR_Y,
    )


def flip_objects(objects: SceneObjects) -> SceneObjects:
    """The objects of the mirrored world, in the mirrored camera."""
    cxcywh, camera = objects.boxes_cxcywh.copy(), objects.boxes3d_camera.copy()
    grid, voxels = objects.boxes3d_grid.copy(), objects.voxels.copy()
    cxcywh[:, 0] = 1 - cxcywh[:, 0]
    camera[:, 0] *= -1
    grid[:, 1] *= -1  # the grid reaches as far to the left as to the right
    voxels[:, 1] = GRID_SHAPE[1] - 1 - voxels[:, 1]
    return dataclasses.replace(
        objects, boxes_cxcywh=cxcywh, boxes3d_camera=camera, boxes3d_grid=grid, voxels=voxels
    )


def jitter_colors(
    image: UInt8[NDArray, "height width 3"], strength: float, rng: np.random.Generator
) -> UInt8[NDArray, "height width 3"]:
    """Change brightness, contrast and saturation, each by a factor from 1 - strength to
    1 + strength."""
    brightness, contrast, saturation = 1 + strength * rng.uniform(-1, 1, size=3)
    pixels: Float32[NDArray, "height width 3"] = image.astype(np.float32) * np.float32(brightness)
    gray = pixels @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    mean = gray.mean()
    pixels = gray[..., None] + (pixels - gray[..., None]) * np.float32(saturation)
    pixels = mean + (pixels - mean) * np.float32(contrast)
    return np.clip(pixels, 0, 255).astype(np.uint8)
