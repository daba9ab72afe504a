"""The picture of a street: one ray per pixel, one towards the sun, then light, haze and noise.

Colours are those of things, not of labels; ``shade.py`` has them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from occdetr.geometry.camera import transform_points
from occdetr.geometry.raycast import camera_rays
from occdetr.streets.scene import Scene, Solids
from occdetr.streets.shade import shade
from occdetr.streets.trace import NOTHING, Hits, Index, lit, trace


@dataclass(frozen=True)
class Light:
    """Where the sun is (unit vector towards it, world frame), how bright, the colours of sky and
    haze, the distance at which haze hides 63 %, the exposure and the sensor's noise."""

    sun: np.ndarray
    sun_strength: float
    ambient: np.ndarray
    zenith: np.ndarray
    horizon: np.ndarray
    visibility: float
    exposure: float
    noise: float
    seed: int


def draw_light(rng: np.random.Generator) -> Light:
    """A random hour and weather: two thirds sunny, the others overcast and without shadows."""
    azimuth, elevation = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(22, 65))
    sun = [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth)]
    sunny = rng.random() < 0.67
    grey = np.array([0.78, 0.80, 0.83])
    warm = rng.normal(0, 0.03) * np.array([1.0, 0.0, -1.0])
    return Light(
        sun=np.array([*sun, math.sin(elevation)]),
        sun_strength=rng.uniform(0.7, 1.0) if sunny else 0.08,
        ambient=(np.array([0.46, 0.50, 0.56]) if sunny else np.array([0.80, 0.82, 0.84])) + warm,
        zenith=np.array([0.30, 0.52, 0.85]) * rng.uniform(0.85, 1.1) if sunny else 0.92 * grey,
        horizon=np.array([0.76, 0.85, 0.94]) if sunny else grey,
        visibility=rng.uniform(120, 450),
        exposure=rng.uniform(0.9, 1.25),
        noise=rng.uniform(1.5, 4.0),
        seed=int(rng.integers(1 << 16)),
    )


class View(NamedTuple):
    """What each pixel sees: rays (origins and unit directions, world frame) and their hits."""

    hits: Hits
    origins: Float[np.ndarray, "ray 3"]
    directions: Float[np.ndarray, "ray 3"]
    image_size: tuple[int, int]


def see(
    index: Index,
    pose: Float[np.ndarray, "4 4"],
    projection: Float[np.ndarray, "3 4"],
    lidar_to_camera: Float[np.ndarray, "4 4"],
    image_size: tuple[int, int],
) -> View:
    """What each pixel sees from a pose (LiDAR frame to world frame)."""
    origins, directions = camera_rays(projection, lidar_to_camera, image_size)
    origins = transform_points(origins, pose)
    directions = np.ascontiguousarray(directions @ pose[:3, :3].T)
    return View(trace(index, origins, directions), origins, directions, image_size)


def render(
    scene: Scene,
    solids: Solids,
    index: Index,
    view: View,
    light: Light,
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "height width 3"]:
    """The RGB picture (height, width) of a view."""
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
    """Slight blur of the lens, exposure, and the sensor's noise."""
    image = cv2.GaussianBlur(image, (3, 3), 0.5) * np.float32(255 * light.exposure)
    image += rng.standard_normal(image.shape, dtype=np.float32) * np.float32(light.noise)
    return np.clip(image, 0, 255).astype(np.uint8)
