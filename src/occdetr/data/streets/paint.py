"""Colours of street surfaces, of the sky and of what lies beyond the world, compiled with numba."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, no_type_check

import numba
import numpy as np
from jaxtyping import Float32

from occdetr.data.streets.layout import Layout
from occdetr.data.streets.world import (
    ASPHALT,
    BARK,
    FENCE,
    GRASS,
    GRAVEL,
    LEAVES,
    PARKING,
    PAVING,
    WALL,
    Palette,
)
from occdetr.geometry.raycast import FACE_NORMALS

if TYPE_CHECKING:
    from occdetr.data.streets.render import Light


def paint_hits(
    palette: Palette,
    layout: Layout,
    materials: np.ndarray,
    points: np.ndarray,
    faces: np.ndarray,
    lit: np.ndarray,
    light: Light,
) -> Float32[np.ndarray, "hit 3"]:
    """Colour (0-1) of each hit: texture times light. ``points`` are metres, ``faces`` as hit."""
    colors = np.empty((len(points), 3), dtype=np.float32)
    lines = np.array(
        [
            *layout.road.coefficients,
            layout.road.half_width,
            float(layout.road.center_line),
            float(layout.road.edge_lines),
            layout.crossing.along if layout.crossing else 1e6,
            layout.crossing.half_width if layout.crossing else 0.0,
        ]
    )
    _paint(
        materials,
        points,
        faces,
        lit,
        *(palette.colors, palette.kinds, palette.yaws.astype(np.float64)),
        lines,
        light.sun,
        light.sun_strength,
        light.ambient,
        FACE_NORMALS,
        colors,
    )
    return colors


def paint_sky(
    directions: np.ndarray,
    zenith: np.ndarray,
    horizon: np.ndarray,
    seed: int,
    colors: Float32[np.ndarray, "ray 3"],
) -> None:
    """Fill ``colors`` with sky, a distant skyline of trees, and ground below the horizon."""
    _sky(directions, zenith, horizon, seed, colors)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _hash(x, y, z):
    """A number in [0, 1) for three integers."""
    value = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    value = ((value ^ (value >> 13)) * 1274126177) & 0x7FFFFFFF
    return ((value ^ (value >> 16)) & 0xFFFF) / 65536.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _noise(x, y, z, cell):
    """Blocky noise in [-0.5, 0.5) with cells of the given size in metres."""
    return _hash(math.floor(x / cell), math.floor(y / cell), math.floor(z / cell)) - 0.5


@numba.njit(cache=True, nogil=True)
@no_type_check
def _smooth(x, y, cell):
    """Noise over the ground in [-0.5, 0.5), interpolated."""
    x, y = x / cell, y / cell
    i, j = math.floor(x), math.floor(y)
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    low = _hash(i, j, 7) * (1 - u) + _hash(i + 1, j, 7) * u
    high = _hash(i, j + 1, 7) * (1 - u) + _hash(i + 1, j + 1, 7) * u
    return low * (1 - v) + high * v - 0.5


@numba.njit(cache=True, nogil=True)
@no_type_check
def _line_paint(x, y, lines):
    """1 where white paint is on the road, else 0."""
    a, b, c, d, half_width, center_line, edge_lines, crossing, crossing_half = lines
    yaw = math.atan(b + x * (2 * c + x * 3 * d))
    lateral = (y - (a + x * (b + x * (c + x * d)))) * math.cos(yaw)
    along = x + lateral * math.sin(yaw)
    if abs(lateral) >= half_width:
        return 0.0
    before = crossing - crossing_half - along
    if -2 * crossing_half < before < 0.5:
        return 0.0
    if 1.0 < before < 4.0:  # zebra
        return 1.0 if (lateral % 1.0) < 0.5 else 0.0
    if center_line > 0 and abs(lateral) < 0.09 and (along % 6.0) < 3.2:
        return 1.0
    if edge_lines > 0 and abs(half_width - 0.3 - abs(lateral)) < 0.08:
        return 1.0
    return 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _ground_texture(kind, x, y, z, lines):
    """(brightness, white paint) of a ground surface."""
    fine, coarse = _noise(x, y, z, 0.04), _smooth(x, y, 1.7)
    if kind == ASPHALT:
        patch = 0.12 if _smooth(x, y, 6.0) > 0.22 else 0.0
        return 1.0 + 0.20 * fine + 0.18 * coarse - patch, _line_paint(x, y, lines)
    if kind == PAVING:
        joint = 0.22 if (x % 0.5) < 0.05 or (y % 0.5) < 0.05 else 0.0
        return 1.0 + 0.16 * _noise(x, y, z, 0.5) + 0.10 * fine - joint, 0.0
    if kind == PARKING:
        row = math.floor(y / 0.12)
        joint = 0.20 if (y % 0.12) < 0.025 or ((x + 0.12 * (row % 2)) % 0.24) < 0.025 else 0.0
        return 1.0 + 0.30 * _noise(x, y, z, 0.12) + 0.10 * coarse - joint, 0.0
    if kind == GRASS:
        return 1.0 + 0.5 * fine + 0.45 * coarse + 0.3 * _smooth(x, y, 0.3), 0.0
    return 1.0 + 0.35 * fine + 0.25 * _smooth(x, y, 0.4) + 0.15 * coarse, 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _object_texture(kind, x, y, z, run):
    """Brightness of a wall, fence, sign or plant; ``run`` is metres along the surface."""
    if kind == WALL:
        pane = (run % 2.6) / 2.6
        storey = ((z + 1.73) % 2.8) / 2.8
        if 0.32 < pane < 0.68 and 0.30 < storey < 0.80:
            frame = pane < 0.36 or pane > 0.64 or abs(pane - 0.5) < 0.02 or storey > 0.77
            return 1.2 if frame else 0.22 + 0.2 * _hash(math.floor(run / 2.6), 3, 5)
        return 1.0 + 0.08 * _noise(x, y, z, 0.06) + 0.10 * _smooth(run, z, 2.0)
    if kind == FENCE:
        return 0.45 if (run % 0.16) < 0.045 else 1.0 + 0.15 * _noise(run, z, 0.0, 0.16)
    if kind == LEAVES:
        return 0.95 + 0.75 * _noise(x, y, z, 0.2) + 0.5 * _noise(x, y, z, 0.06)
    if kind == BARK:
        return 1.0 + 0.5 * _noise(x, y, z * 0.2, 0.05)
    return 1.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _shading_normal(face, kind, yaw, normals):
    """The normal to shade with: of steps of a turned surface, that of the surface."""
    nx, ny, nz = normals[face, 0], normals[face, 1], normals[face, 2]
    if ASPHALT <= kind <= GRAVEL:
        return 0.0, 0.0, 1.0
    if nz != 0.0 or yaw == 0.0:
        return nx, ny, nz
    cos, sin = math.cos(yaw), math.sin(yaw)
    ahead, left = nx * cos + ny * sin, ny * cos - nx * sin
    if abs(ahead) > abs(left):
        sign = 1.0 if ahead > 0 else -1.0
        return sign * cos, sign * sin, 0.0
    sign = 1.0 if left > 0 else -1.0
    return -sign * sin, sign * cos, 0.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def _paint(
    materials, points, faces, lit, palette, kinds, yaws, lines, sun, strength, ambient, normals, out
):
    for hit in range(len(points)):
        material = materials[hit]
        kind, yaw, face = kinds[material], yaws[material], max(faces[hit], 0)
        x, y, z = points[hit]
        nx, ny, nz = _shading_normal(face, kind, yaw, normals)
        white = 0.0
        if ASPHALT <= kind <= GRAVEL:
            bright, white = _ground_texture(kind, x, y, z, lines)
            if face < 4 and kind == PAVING:  # the kerb's side
                bright, white = 1.15, 0.0
        else:
            # run along the surface: turn the position into the material's own direction
            side = abs(-nx * math.sin(yaw) + ny * math.cos(yaw)) > 0.7
            cos, sin = math.cos(yaw), math.sin(yaw)
            run = x * cos + y * sin if side else y * cos - x * sin
            bright = 1.0 if nz != 0 and kind != LEAVES else _object_texture(kind, x, y, z, run)
        shade = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0) * strength * lit[hit]
        sky = 0.72 + 0.28 * nz + 0.06 * nx
        for channel in range(3):
            albedo = palette[material, channel] * bright * (1 - white) + 0.85 * white
            out[hit, channel] = albedo * (ambient[channel] * sky + shade)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _sky(directions, zenith, horizon, seed, out):
    for ray in range(len(directions)):
        x, y, z = directions[ray]
        azimuth = math.atan2(y, x)
        skyline = 0.012 + 0.035 * (_smooth(azimuth * 60 + seed % 997, 0.5, 4.0) + 0.5)
        skyline += 0.008 * _smooth(azimuth * 60, 7.5, 0.5)
        height = max(z, 0.0)
        blend = min(height * 2.2, 1.0)
        cloud = max(_smooth(azimuth * 9 + seed % 991, z * 30, 1.3), 0.0) * 0.35
        for channel in range(3):
            clear = horizon[channel] * (1 - blend) + zenith[channel] * blend
            color = clear + (1.0 - clear) * cloud
            if z < skyline:  # woods and hills, hazy
                green = 0.30 + 0.10 * channel - 0.05 * channel * channel
                color = 0.55 * green + 0.45 * horizon[channel]
            if z < -0.015:
                color = (0.42, 0.43, 0.38)[channel] * 0.6 + 0.4 * horizon[channel]
            out[ray, channel] = color
