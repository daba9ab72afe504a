"""Augmentation that keeps picture, camera, boxes and grid true to each other."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from occdetr.data.clusters import Clusters
from occdetr.data.objects import ObjectSettings, SceneObjects, see_clusters
from occdetr.geometry.camera import crop_projection
from occdetr.geometry.kitti import Calibration
from occdetr.geometry.voxels import GRID_SHAPE

_MIRROR_X = np.diag([-1.0, 1.0, 1.0, 1.0])
_MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])


class Window(NamedTuple):
    """A part of a picture: its first pixel and its size, in whole pixels."""

    left: int
    top: int
    width: int
    height: int


def draw_window(
    size: tuple[int, int], scale: tuple[float, float], rng: np.random.Generator
) -> Window:
    """A random part of a picture of ``size`` (height, width), anywhere within it.

    Its edges are the picture's divided by a number drawn from ``scale``, (least, most): so much
    larger is everything once the part is brought to the picture's size. Both are at least 1: less
    would need padding, which the network has no masks for and no picture to be predicted shows.
    """
    factor = rng.uniform(*scale)
    height, width = (max(1, round(edge / factor)) for edge in size)
    left, top = rng.integers((size[1] - width, size[0] - height), endpoint=True).tolist()
    return Window(left, top, width, height)


def crop_image(
    image: UInt8[NDArray, "height width 3"], window: Window
) -> UInt8[NDArray, "new_height new_width 3"]:
    """The pixels of the window, as a view."""
    left, top, width, height = window
    return image[top : top + height, left : left + width]


def crop_calibration(calibration: Calibration, window: Window) -> Calibration:
    """The camera whose picture is the window."""
    projection = crop_projection(calibration.projection, window.left, window.top)
    return dataclasses.replace(calibration, projection=projection)


def crop_objects(
    objects: SceneObjects,
    labels: UInt8[NDArray, "x y z"],
    calibration: Calibration,
    window: Window,
    settings: ObjectSettings,
) -> SceneObjects:
    """Those objects that are seen in a window of the picture, as ``calibration``, the window's own
    camera, sees them.

    Rays are cast anew, since an object leaves with its last visible pixel, though hidden parts of
    it may be in the window still; and the 2D boxes are made anew from the voxels, since a slanting
    object within the window is smaller than its box cut by the window.
    """
    clusters = Clusters(objects.classes.astype(np.uint8), objects.voxels, objects.voxel_object)
    return see_clusters(labels, clusters, calibration, (window.height, window.width), settings)


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
    gray = np.array([0.299, 0.587, 0.114])
    mean = brightness * gray @ np.array(cv2.mean(image)[:3])
    # away from each pixel's gray, and from the mean gray: one affine map of the colours
    matrix = contrast * brightness * (saturation * np.eye(3) + (1 - saturation) * gray)
    shift = np.full((3, 1), (1 - contrast) * mean)
    return cv2.transform(image, np.hstack([matrix, shift]))
