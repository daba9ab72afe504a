"""The picture of a street: one ray per pixel into the voxels, then colour, light, haze and noise.

Colours are those of things, not of labels. Textures are functions of the place in the world, so
that they hold still between views; ``paint.py`` has them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from occdetr.data.streets.layout import Layout
from occdetr.data.streets.paint import paint_hits, paint_sky
from occdetr.data.streets.world import (
    ASPHALT,
    GRASS,
    GRAVEL,
    PARKING,
    WORLD_ORIGIN,
    World,
)
from occdetr.geometry.raycast import FACE_NORMALS, camera_rays, cast_rays
from occdetr.geometry.voxels import VOXEL_SIZE


@dataclass(frozen=True)
class Light:
    """Where the sun is (unit vector towards it), how bright, and the colour of sky and haze."""

    sun: np.ndarray
    sun_strength: float
    ambient: np.ndarray
    zenith: np.ndarray
    horizon: np.ndarray
    visibility: float
    exposure: float


def draw_light(rng: np.random.Generator) -> Light:
    """A random hour and weather: two thirds sunny, the others overcast and without shadows."""
    azimuth, elevation = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(22, 65))
    sun = [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth)]
    sunny = rng.random() < 0.67
    grey = np.array([0.78, 0.80, 0.83])
    return Light(
        sun=np.array([*sun, math.sin(elevation)]),
        sun_strength=rng.uniform(0.65, 0.95) if sunny else 0.12,
        ambient=np.array([0.54, 0.57, 0.62]) if sunny else np.array([0.80, 0.82, 0.84]),
        zenith=np.array([0.30, 0.52, 0.85]) * rng.uniform(0.85, 1.1) if sunny else 0.92 * grey,
        horizon=np.array([0.76, 0.85, 0.94]) if sunny else grey,
        visibility=rng.uniform(120, 400),
        exposure=rng.uniform(1.0, 1.3),
    )


def render_street(
    world: World,
    layout: Layout,
    projection: Float[np.ndarray, "3 4"],
    lidar_to_camera: Float[np.ndarray, "4 4"],
    image_size: tuple[int, int],
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "height width 3"]:
    """The RGB picture (height, width) that a camera takes of the street."""
    light = draw_light(rng)
    origins, directions = camera_rays(projection, lidar_to_camera, image_size)
    start = (origins - np.array(WORLD_ORIGIN)) / VOXEL_SIZE
    hits, distances, faces = cast_rays(world.materials, start, directions)
    seen = np.flatnonzero(hits[:, 0] >= 0)
    points = start[seen] + distances[seen, None] * directions[seen]
    materials = world.materials[tuple(hits[seen].T)]
    _level_ground(world.palette.kinds[materials], points, faces, hits, seen)
    lit = _sunlit(world, points, faces[seen], light)

    colors = np.empty((len(directions), 3), dtype=np.float32)
    paint_sky(directions, light.zenith, light.horizon, int(rng.integers(1 << 20)), colors)
    metres = points * VOXEL_SIZE + np.array(WORLD_ORIGIN)
    colors[seen] = paint_hits(world.palette, layout, materials, metres, faces[seen], lit, light)
    haze = np.exp(-distances[seen] * VOXEL_SIZE / light.visibility)[:, None].astype(np.float32)
    colors[seen] = colors[seen] * haze + light.horizon.astype(np.float32) * (1 - haze)
    return _expose(colors.reshape(*image_size, 3), light, rng)


def _level_ground(
    kinds: np.ndarray, points: np.ndarray, faces: np.ndarray, hits: np.ndarray, seen: np.ndarray
) -> None:
    """Let the steps in sloping ground pass for its surface, in place; kerbs stay."""
    steps = np.flatnonzero(np.isin(kinds, (ASPHALT, PARKING, GRASS, GRAVEL)) & (faces[seen] < 4))
    points[steps, 2] = hits[seen[steps], 2] + 1
    faces[seen[steps]] = 5


def _sunlit(
    world: World, points: np.ndarray, faces: np.ndarray, light: Light
) -> Float[np.ndarray, " hit"]:
    """1 where the sun reaches a point, else 0, by a second ray."""
    normals = FACE_NORMALS[faces].astype(np.float64)
    lit = (normals @ light.sun > 0).astype(np.float32)
    if light.sun_strength < 0.2:
        return np.ones_like(lit)
    facing = np.flatnonzero(lit)
    start = points[facing] + 0.02 * normals[facing]
    blocked, _, _ = cast_rays(world.materials, start, np.broadcast_to(light.sun, start.shape))
    lit[facing] = blocked[:, 0] < 0
    return lit


def _expose(
    image: np.ndarray, light: Light, rng: np.random.Generator
) -> UInt8[np.ndarray, "height width 3"]:
    """Slight blur of the lens, exposure, a soft shoulder and the sensor's noise."""
    image = cv2.GaussianBlur(image, (3, 3), 0.45) * np.float32(255 * light.exposure)
    image += rng.standard_normal(image.shape, dtype=np.float32) * np.float32(2.5)
    return np.clip(image, 0, 255).astype(np.uint8)
