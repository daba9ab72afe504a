"""Augmentation that transforms image, camera, boxes and voxel labels consistently."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from occdetr.data.clusters import Clusters
from occdetr.data.objects import ObjectSettings, SceneObjects, visible_objects
from occdetr.errors import BELOW_ONE, SHARE, InputError, check_ranges
from occdetr.geometry.camera import Camera, crop_camera
from occdetr.geometry.voxels import GRID_SHAPE

MAX_SCALE = 4.0  # of an image of KITTI's size, this leaves 92 x 306 pixels


@dataclass(frozen=True)
class Augmentation:
    """What may be changed in a training frame; the default changes nothing.

    ``flip`` is the probability of mirroring a frame left to right. ``photometric`` is the strength
    of colour changes, see ``jitter_colors``, and ``sensor`` that of what differs between cameras,
    see ``change_sensor``. ``scale`` is the range (smallest, largest) of the factor by which a
    random window of the image is enlarged to the size of the whole.

    Raises ``InputError`` on values out of range.
    """

    flip: float = 0.0
    photometric: float = 0.0
    sensor: float = 0.0
    scale: Sequence[float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        check_ranges("data", self, flip=SHARE, photometric=BELOW_ONE, sensor=SHARE)
        object.__setattr__(self, "scale", _scale_range(self.scale))


def _scale_range(scale: Sequence[float]) -> tuple[float, float]:
    try:
        least, most = map(float, scale)
    except (TypeError, ValueError):
        least = most = math.nan
    if not 1 <= least <= most <= MAX_SCALE:  # false for NaN too
        raise InputError(
            f"data.scale={scale}: give [least, most] with 1 <= least <= most <= {MAX_SCALE:g}, "
            "as in [1.0, 1.25]; [1.0, 1.0] changes nothing"
        )
    return least, most


class Window(NamedTuple):
    """A part of an image: its first pixel and its size, in whole pixels."""

    left: int
    top: int
    width: int
    height: int


def draw_window(size: tuple[int, int], scale: Sequence[float], rng: np.random.Generator) -> Window:
    """A window of random size at a random place of an image of ``size`` (height, width).

    The image's height and width are divided by a factor drawn uniformly from ``scale`` (smallest,
    largest). Factors below 1 are not possible: they would need padding, for which the network has
    no masks.
    """
    least, most = scale
    factor = rng.uniform(least, most)
    height, width = (max(1, round(edge / factor)) for edge in size)
    left, top = rng.integers((size[1] - width, size[0] - height), endpoint=True).tolist()
    return Window(left, top, width, height)


def crop_picture(
    image: UInt8[NDArray, "height width 3"], camera: Camera, window: Window
) -> tuple[UInt8[NDArray, "new_height new_width 3"], Camera]:
    """The pixels of a window, as a view, and its camera."""
    left, top, width, height = window
    part = image[top : top + height, left : left + width]
    return part, crop_camera(camera, left, top, (height, width))


def crop_objects(
    objects: SceneObjects,
    labels: UInt8[NDArray, "x y z"],
    camera: Camera,
    settings: ObjectSettings,
) -> SceneObjects:
    """Those objects that are visible in a window of the image; ``camera`` is the window's.

    Rays are cast again, because an object is dropped with its last visible pixel even if hidden
    parts of it are in the window. The 2D boxes are computed again from the voxels, because the part
    of a slanted object in the window can be smaller than its box clipped to the window.
    """
    clusters = Clusters(objects.classes.astype(np.uint8), objects.voxels, objects.voxel_object)
    return visible_objects(labels, clusters, camera, settings)


def flip_objects(objects: SceneObjects) -> SceneObjects:
    """The objects of the mirrored world, see ``occdetr.geometry.camera.flip_camera``."""
    cxcywh, camera = objects.boxes_cxcywh.copy(), objects.boxes3d_camera.copy()
    grid, voxels = objects.boxes3d_grid.copy(), objects.voxels.copy()
    cxcywh[:, 0] = 1 - cxcywh[:, 0]
    camera[:, 0] *= -1
    grid[:, 1] *= -1  # the grid is symmetric in y
    voxels[:, 1] = GRID_SHAPE[1] - 1 - voxels[:, 1]
    return dataclasses.replace(
        objects, boxes_cxcywh=cxcywh, boxes3d_camera=camera, boxes3d_grid=grid, voxels=voxels
    )


def jitter_colors(
    image: UInt8[NDArray, "height width 3"], strength: float, rng: np.random.Generator
) -> UInt8[NDArray, "height width 3"]:
    """Scale brightness, contrast and saturation, each by a factor drawn uniformly from
    [1 - strength, 1 + strength]."""
    brightness, contrast, saturation = 1 + strength * rng.uniform(-1, 1, size=3)
    gray = np.array([0.299, 0.587, 0.114])
    mean = brightness * gray @ np.array(cv2.mean(image)[:3])
    # Saturation scales the distance from each pixel's gray value, contrast that from the mean gray
    # value; together they are one affine map of the colours.
    matrix = contrast * brightness * (saturation * np.eye(3) + (1 - saturation) * gray)
    shift = np.full((3, 1), (1 - contrast) * mean)
    return cv2.transform(image, np.hstack([matrix, shift]))


def change_sensor(
    image: UInt8[NDArray, "height width 3"], strength: float, rng: np.random.Generator
) -> UInt8[NDArray, "height width 3"]:
    """Change what differs between cameras, and between rendered and real images.

    White balance (each channel by up to 16 % at ``strength`` 1) and gamma (0.6 to 1.65); then, each
    for half of the images, blur (sigma up to 1.2 pixels), noise (standard deviation up to 12) and
    JPEG compression (quality down to 30).
    """
    gain, gamma = (
        np.exp(strength * rng.uniform(-0.15, 0.15, 3)),
        np.exp(strength * rng.uniform(-0.5, 0.5)),
    )
    curve = 255 * gain * np.linspace(0, 1, 256)[:, None] ** gamma
    image = cv2.LUT(image, np.rint(curve.clip(0, 255)).astype(np.uint8)[:, None])
    chosen, amount = rng.random(3) < 0.5, strength * rng.random(3)
    if chosen[0] and (sigma := 1.2 * amount[0]) > 0.2:  # less is nothing
        image = cv2.GaussianBlur(image, (0, 0), sigma)
    if chosen[1]:
        noise = 12 * amount[1] * rng.standard_normal(image.shape, dtype=np.float32)
        image = np.rint((image + noise).clip(0, 255)).astype(np.uint8)
    if chosen[2]:
        quality = [cv2.IMWRITE_JPEG_QUALITY, round(95 - 65 * amount[2])]
        file = cv2.imencode(".jpg", image, quality)[1]
        image = np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR))
    return image
