"""Sun, sky and haze of a world, and the camera's exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Light:
    """Lighting of a world.

    ``sun`` is the unit vector towards the sun (world frame), ``ambient``, ``zenith`` and
    ``horizon`` are RGB colours. Haze has absorbed 63 % of the light after ``visibility``
    metres. ``noise`` is the standard deviation of the sensor's noise in grey levels, ``seed`` that
    of the textures of sky and ground.
    """

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
    """Lighting at a random time of day: two thirds sunny, the others overcast without shadows."""
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
