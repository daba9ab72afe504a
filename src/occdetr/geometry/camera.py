"""The pinhole camera. Every function takes NumPy arrays or tensors alike, with any leading axes.

Pixel coordinates are KITTI's: pixel (0, 0) has its centre at (0, 0). Normalised image coordinates
run from 0 to 1 between the outer edges of the image, as ``grid_sample(align_corners=False)`` has
them. Camera axes: x right, y down, z forward, in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from occdetr.errors import InputError

MIN_DEPTH = 0.1  # metres in front of the camera plane, below which nothing is projected
MIN_IMAGE_SIDE, MAX_IMAGE_SIDE = 32, 2**14  # pixels, of the width and height of an image


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, or one camera for each frame of a batch; NumPy arrays or tensors.

    ``projection`` maps camera coordinates in metres to pixels of an image of ``image_size``
    (height, width); it is KITTI's P2 with its fourth column. ``lidar_to_camera`` maps the grid
    frame to the camera frame (KITTI's Tr).
    """

    projection: Float[np.ndarray, "*batch 3 4"] | Float[Tensor, "*batch 3 4"]
    lidar_to_camera: Float[np.ndarray, "*batch 4 4"] | Float[Tensor, "*batch 4 4"]
    image_size: tuple[int, int]


def check_image_size(setting: str, size: Sequence[int]) -> tuple[int, int]:
    """``size`` as (height, width). Raises ``InputError`` if it is none, too small or too large."""
    if len(size) != 2 or any(int(side) != side or side < 1 for side in size):
        raise InputError(f"{setting}={list(size)}: must be [height, width] in pixels")
    if min(size) < MIN_IMAGE_SIDE:
        raise InputError(f"{setting}={list(size)}: give {MIN_IMAGE_SIDE} pixels or more")
    if max(size) > MAX_IMAGE_SIDE:
        raise InputError(f"{setting}={list(size)}: give {MAX_IMAGE_SIDE} pixels or less")
    return int(size[0]), int(size[1])


def rotate(points: Any, matrix: Any) -> Any:
    """``matrix`` [..., 3, 3] times each of ``points`` [..., N, 3].

    It is not a matrix product, which would run in bf16 under autocast and in TF32 on a GPU. At 50 m
    that would be an error of one voxel.
    """
    return (points[..., None, :] * matrix[..., None, :, :]).sum(-1)


def transform_points(points: Any, transform: Any) -> Any:
    """Apply a rigid ``transform`` [..., 4, 4] to ``points`` [..., N, 3]."""
    return rotate(points, transform[..., :3, :3]) + transform[..., None, :3, 3]


def invert_transform(transform: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """The inverse of affine transforms, from the cofactors of their 3 x 3 part.

    Elementwise, so that a GPU waits for nothing and every export knows it; ``torch.linalg.inv``
    checks on the host whether it has succeeded.
    """
    a, b, c = transform[..., :3, :3].unbind(-2)
    columns = torch.stack([_cross(b, c), _cross(c, a), _cross(a, b)], dim=-1)
    inverse = columns / (a * columns[..., 0]).sum(-1)[..., None, None]
    origin = -(inverse * transform[..., None, :3, 3]).sum(-1)
    return torch.cat([torch.cat([inverse, origin[..., None]], -1), transform[..., 3:, :]], dim=-2)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a.roll(-1, -1) * b.roll(-2, -1) - a.roll(-2, -1) * b.roll(-1, -1)


def project_points(points: Any, projection: Any) -> tuple[Any, Any]:
    """Project camera-frame ``points`` [..., N, 3] with a 3 x 4 ``projection`` [..., 3, 4].

    Returns pixels [..., N, 2] and depths [..., N] in metres. Points nearer than ``MIN_DEPTH`` are
    projected as if they were at that depth, so test the returned depth.
    """
    homogeneous = rotate(points, projection[..., :3, :3]) + projection[..., None, :3, 3]
    depth = homogeneous[..., 2]
    safe = depth.clip(MIN_DEPTH)
    return homogeneous[..., :2] / safe[..., None], depth


def unproject(pixels: Any, depth: Any, projection: Any) -> Any:
    """Camera-frame points [..., N, 3] whose z is ``depth`` [..., N] and that project to ``pixels``.

    Closed form for a projection whose last row is (0, 0, 1, t): P2 of KITTI, its fourth column
    included.
    """
    p = projection[..., None, :, :]
    scale = depth + p[..., 2, 3]
    y = (scale * pixels[..., 1] - p[..., 1, 2] * depth - p[..., 1, 3]) / p[..., 1, 1]
    x = (scale * pixels[..., 0] - p[..., 0, 2] * depth - p[..., 0, 3] - p[..., 0, 1] * y) / p[
        ..., 0, 0
    ]
    return _stack([x, y, depth])


def resize_camera(camera: Camera, image_size: tuple[int, int]) -> Camera:
    """The camera of the same image resized to ``image_size`` (height, width).

    The image's outer edges stay where they are, so pixel centres shift by half a pixel. NumPy
    arrays without batch axes; float64.
    """
    scale_y, scale_x = (new / old for new, old in zip(image_size, camera.image_size, strict=True))
    resize = np.array(
        [
            [scale_x, 0.0, 0.5 * scale_x - 0.5],
            [0.0, scale_y, 0.5 * scale_y - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    return Camera(_map_pixels(resize, camera), camera.lidar_to_camera, image_size)


def crop_camera(camera: Camera, left: int, top: int, image_size: tuple[int, int]) -> Camera:
    """The camera of the part of the image with ``image_size`` (height, width) pixels whose first
    pixel is (``left``, ``top``). NumPy arrays without batch axes; float64."""
    shift = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]])
    return Camera(_map_pixels(shift, camera), camera.lidar_to_camera, image_size)


def flip_camera(camera: Camera) -> Camera:
    """The camera of the mirrored world.

    It sees the point (x, -y, z) of the grid frame at pixel (width - 1 - u, v) where ``camera`` sees
    (x, y, z) at (u, v). The camera's x axis is mirrored too, so both matrices change, including the
    fourth column of the projection. NumPy arrays without batch axes; float64.
    """
    width = camera.image_size[1]
    mirror_u = np.array([[-1.0, 0.0, width - 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    mirror_x, mirror_y = np.diag([-1.0, 1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0, 1.0])
    return Camera(
        projection=_map_pixels(mirror_u, camera) @ mirror_x,
        lidar_to_camera=mirror_x @ np.asarray(camera.lidar_to_camera) @ mirror_y,
        image_size=camera.image_size,
    )


def _map_pixels(transform: NDArray, camera: Camera) -> NDArray[np.float64]:
    """The projection followed by a ``transform`` [3, 3] of homogeneous pixel coordinates."""
    return transform @ np.asarray(camera.projection, dtype=np.float64)


def normalize_pixels(pixels: Any, image_size: tuple[int, int]) -> Any:
    """Pixels (u, v) -> normalised image coordinates; ``image_size`` is (height, width)."""
    height, width = image_size
    return _stack([(pixels[..., 0] + 0.5) / width, (pixels[..., 1] + 0.5) / height])


def denormalize_pixels(points: Any, image_size: tuple[int, int]) -> Any:
    """Normalised image coordinates -> pixels (u, v)."""
    height, width = image_size
    return _stack([points[..., 0] * width - 0.5, points[..., 1] * height - 0.5])


def _stack(parts: list[Any]) -> Any:
    if isinstance(parts[0], np.ndarray):
        return np.stack(parts, axis=-1)
    return torch.stack(parts, dim=-1)
