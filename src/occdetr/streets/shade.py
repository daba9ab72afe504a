"""Shading of surfaces, reflections, haze, sky and horizon (numba)."""

from __future__ import annotations

import math
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32

from occdetr.streets.ambient_occlusion import interpolate, sky_visibility
from occdetr.streets.ground import CELL, locate, surface_at
from occdetr.streets.light import Light
from occdetr.streets.noise import smooth2
from occdetr.streets.pavement import ground_texture
from occdetr.streets.scene import Scene, Solids
from occdetr.streets.textures import solid_texture
from occdetr.streets.trace import GROUND, NOTHING, Hits, Index

FOOT = 0.6  # height in metres below which solids are darkened
SHINE = 40  # exponent of the sun's specular reflection
LAND = (0.40, 0.42, 0.34)  # RGB of the land beyond the world


def shade(
    scene: Scene,
    solids: Solids,
    index: Index,
    hits: Hits,
    points: Float[np.ndarray, "ray 3"],
    directions: Float[np.ndarray, "ray 3"],
    sunlit: Float32[np.ndarray, " ray"],
    light: Light,
) -> Float32[np.ndarray, "ray 3"]:
    """Colour (0-1, before exposure) of what each ray hits, including haze and sky."""
    colors = np.empty((len(points), 3), dtype=np.float32)
    palette = scene.palette
    sky = (light.zenith, light.horizon, light.sun, light.sun_strength, light.seed)
    _shade(
        *(hits.solids, hits.distances, hits.normals, points, directions, sunlit),
        *(solids.geometry, solids.forms, solids.materials, palette.colors, palette.textures),
        *(scene.plan, index.heights, index.origin, sky_visibility(solids, index)),
        *(light.ambient, light.visibility, sky, colors),
    )
    return colors


@numba.njit(cache=True, nogil=True)
@no_type_check
def _shade(
    found, distances, normals, points, directions, sunlit,
    geometry, forms, materials, palette, textures,
    plan, heights, origin, open_ground, ambient, visibility, sky, out,
):  # fmt: skip
    _, horizon, sun, strength, seed = sky
    mirrored = np.zeros(3)
    for ray in range(len(found)):
        solid, distance = found[ray], distances[ray]
        d = directions[ray]
        if solid == NOTHING:
            _sky(d[0], d[1], d[2], sky, out[ray])
            continue
        p, n = points[ray], normals[ray]
        if solid == GROUND:
            along, lateral = locate(p[0], p[1], plan.road)
            material, _ = surface_at(along, lateral, plan)
            bright, share, red, green, blue, gloss = ground_texture(
                textures[material], material, p[0], p[1], along, lateral, distance, n[2], plan, seed
            )
            open_sky = interpolate(open_ground, origin, p[0], p[1])
        else:
            material = materials[solid]
            bright, share, red, green, blue, gloss = solid_texture(
                textures[material], geometry[solid], forms[solid], solid, p, n, distance
            )
            low = 1.0 - _height_above_ground(heights, origin, p) / FOOT
            open_sky = 1.0 - 0.4 * low * low if low > 0.0 else 1.0
        open_sky *= 0.70 + 0.30 * n[2] + 0.05 * n[0]
        facing = n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]
        direct = max(facing, 0.0) * strength * sunlit[ray]
        haze = math.exp(-distance / visibility)
        mirror = _reflect(d, n, gloss, direct, ambient, sky, mirrored) if gloss > 0.0 else 0.0
        cover = red, green, blue
        for channel in range(3):
            albedo = palette[material, channel] * bright * (1 - share) + cover[channel] * share
            color = albedo * (ambient[channel] * open_sky + direct)
            color += mirror * (mirrored[channel] - color)
            out[ray, channel] = color * haze + horizon[channel] * (1 - haze)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _height_above_ground(heights, origin, p):
    """Height above the ground in metres."""
    i, j = int((p[0] - origin[0]) / CELL + 0.5), int((p[1] - origin[1]) / CELL + 0.5)
    i, j = min(max(i, 0), heights.shape[0] - 1), min(max(j, 0), heights.shape[1] - 1)
    return max(p[2] - heights[i, j], 0.0)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _reflect(d, n, gloss, direct, ambient, sky, color):
    """The share of light that a glossy surface reflects (Schlick's approximation). Writes the
    reflected colour (sky, the other side of the street, the road) to ``color``."""
    zenith, horizon, sun, strength, seed = sky
    facing = -(d[0] * n[0] + d[1] * n[1] + d[2] * n[2])
    x, y, z = d[0] + 2 * facing * n[0], d[1] + 2 * facing * n[1], d[2] + 2 * facing * n[2]
    share = gloss * (0.28 + 0.72 * (1.0 - max(facing, 0.0)) ** 4)
    skyline = 0.12 + 0.24 * smooth2(6.0 * x, 6.0 * y, 1.0, seed + 5)
    above = min(max((z - skyline) / 0.06 + 0.5, 0.0), 1.0)
    below = min(max(-z / 0.10 + 0.5, 0.0), 1.0)
    blend = min(max(z, 0.0) * 1.3, 1.0)
    spot = max(x * sun[0] + y * sun[1] + z * sun[2], 0.0) ** SHINE if direct > 0.0 else 0.0
    houses, road = 0.24, 0.26 + 0.14 * strength
    for channel in range(3):
        high = horizon[channel] * (1 - blend) + zenith[channel] * blend
        side = houses * (ambient[channel] + 0.3 * strength)
        seen = side + above * (high - side) + below * (road * ambient[channel] - side)
        color[channel] = seen + 4.0 * strength * spot
    return share


@numba.njit(cache=True, nogil=True)
@no_type_check
def _sky(x, y, z, sky, color):
    """Write the colour of the background to ``color``: sky with clouds and the sun's glow, distant
    hills and woods, land below them."""
    zenith, horizon, sun, strength, seed = sky
    azimuth = math.atan2(y, x) * 60
    hills = 0.020 + 0.045 * (smooth2(azimuth, 0.5, 11.0, seed) + 0.3)
    woods = 0.006 + 0.030 * (smooth2(azimuth, 3.5, 3.0, seed) + 0.4)
    woods += 0.010 * smooth2(azimuth, 7.5, 0.35, seed) + 0.006 * smooth2(azimuth, 9.5, 0.12, seed)
    blend = min(max(z, 0.0) * 2.2, 1.0)
    glow = max(x * sun[0] + y * sun[1] + z * sun[2], 0.0) ** 6 * 0.35 * strength
    cloud = 0.0
    if z > 0.0:  # a layer of clouds, seen from below
        far = 1.0 / (z + 0.12)
        u, v = x * far, y * far
        heap = smooth2(u, v, 1.1, seed + 1) + 0.5 * smooth2(u, v, 0.45, seed + 2)
        heap += 0.25 * smooth2(u, v, 0.18, seed + 3)
        cloud = min(max(1.6 * heap + 0.1, 0.0), 0.9) * min(6.0 * z, 1.0)
    for channel in range(3):
        clear = horizon[channel] * (1 - blend) + zenith[channel] * blend
        seen = clear + (0.96 - clear) * min(cloud + glow, 1.0)
        leaf = 0.26 + 0.10 * channel - 0.07 * channel * channel
        if z < hills:
            seen = 0.25 * leaf + 0.75 * horizon[channel] * (0.88 + 0.05 * channel)
        if z < woods:
            seen = 0.6 * leaf + 0.4 * horizon[channel]
        if z < -0.02:
            seen = 0.55 * LAND[channel] + 0.45 * horizon[channel]
        color[channel] = seen
