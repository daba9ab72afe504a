"""Rendering of a street by ray tracing: one ray per pixel and one shadow ray towards the sun.

``shade.py`` computes the colours, which are those of materials, not of labels.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from occdetr.geometry.camera import Camera, transform_points
from occdetr.geometry.raycast import camera_rays
from occdetr.streets.light import Light
from occdetr.streets.scene import Scene, Solids
from occdetr.streets.shade import shade
from occdetr.streets.trace import NOTHING, Hits, Index, lit, trace


class View(NamedTuple):
    """What each pixel sees: rays (origins and unit directions, world frame) and their hits."""

    hits: Hits
    origins: Float[np.ndarray, "ray 3"]
    directions: Float[np.ndarray, "ray 3"]
    image_size: tuple[int, int]


def trace_view(index: Index, pose: Float[np.ndarray, "4 4"], camera: Camera) -> View:
    """Trace one ray through each pixel; ``pose`` maps the LiDAR frame to the world frame."""
    origins, directions = camera_rays(camera)
    origins = transform_points(origins, pose)
    directions = np.ascontiguousarray(directions @ pose[:3, :3].T)
    return View(trace(index, origins, directions), origins, directions, camera.image_size)


def render(
    scene: Scene,
    solids: Solids,
    index: Index,
    view: View,
    light: Light,
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "height width 3"]:
    """The RGB image of a view."""
    hits, origins, directions, image_size = view
    distances = np.where(hits.solids == NOTHING, 0.0, hits.distances)[:, None]
    points = origins + distances * directions
    sunlit = np.ones(len(points), dtype=np.float32)
    if light.sun_strength > 0.2:
        facing = np.flatnonzero((hits.solids != NOTHING) & (hits.normals @ light.sun > 0))
        start = points[facing] + 0.01 * hits.normals[facing]
        sunlit[facing] = lit(index, start, light.sun)
    colors = shade(scene, solids, index, hits, points, directions, sunlit, light)
    return _expose(colors.reshape(*image_size, 3), light, rng)


def _expose(
    image: np.ndarray, light: Light, rng: np.random.Generator
) -> UInt8[np.ndarray, "height width 3"]:
    """Apply the lens's blur, the exposure and the sensor's noise."""
    image = cv2.GaussianBlur(image, (3, 3), 0.5) * np.float32(255 * light.exposure)
    image += rng.standard_normal(image.shape, dtype=np.float32) * np.float32(light.noise)
    return np.clip(image, 0, 255).astype(np.uint8)
