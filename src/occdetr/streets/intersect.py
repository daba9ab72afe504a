"""Intersection of rays with solids in the solid's frame, compiled with numba.

``g`` is a row of ``Solids.geometry``, (x, y, z) the ray's origin and (u, v, w) its direction. Each
function returns the distance of the first entry beyond ``start`` (infinite if there is none) and a
normal, which is not normalised.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba


@numba.njit(cache=True, nogil=True)
@no_type_check
def intersect_box(g, x, y, z, u, v, w, start):
    """Entry into a box with sloped sides: six half-spaces n . p <= b."""
    hx, hy, hz = g[5], g[6], g[7]
    lean_x = hx * (1.0 - g[8]) / (2 * hz)  # decrease of the half width per metre of height
    lean_y = hy * (1.0 - g[9]) / (2 * hz)
    move = hx * g[10] / (2 * hz)  # shift of the centre per metre of height
    mean_x, mean_y = hx * (1.0 + g[8]) / 2, hy * (1.0 + g[9]) / 2
    near, far = -math.inf, math.inf
    nx, ny, nz = 0.0, 0.0, 1.0
    for side in range(6):
        if side == 0:
            ax, ay, az, b = 0.0, 0.0, 1.0, hz
        elif side == 1:
            ax, ay, az, b = 0.0, 0.0, -1.0, hz
        elif side == 2:
            ax, ay, az, b = 1.0, 0.0, lean_x - move, mean_x + move * hz
        elif side == 3:
            ax, ay, az, b = -1.0, 0.0, lean_x + move, mean_x - move * hz
        elif side == 4:
            ax, ay, az, b = 0.0, 1.0, lean_y, mean_y
        else:
            ax, ay, az, b = 0.0, -1.0, lean_y, mean_y
        speed = ax * u + ay * v + az * w
        gap = b - (ax * x + ay * y + az * z)
        if speed == 0.0:
            if gap < 0.0:
                return math.inf, 0.0, 0.0, 1.0
        elif speed < 0.0:
            if gap / speed > near:
                near, nx, ny, nz = gap / speed, ax, ay, az
        else:
            far = min(far, gap / speed)
        if near > far:
            return math.inf, 0.0, 0.0, 1.0
    return (near if near >= start else math.inf), nx, ny, nz


@numba.njit(cache=True, nogil=True)
@no_type_check
def intersect_cylinder(g, x, y, z, u, v, w, start):
    """Entry into an upright elliptic frustum."""
    hx, hy, hz = g[5], g[6], g[7]
    lean = (1.0 - g[8]) / (2 * hz)
    middle = (1.0 + g[8]) / 2
    x, y, u, v = x / hx, y / hy, u / hx, v / hy
    s, ds = middle - lean * z, -lean * w  # relative radius and its change along the ray
    a = u * u + v * v - ds * ds
    b = x * u + y * v - s * ds
    c = x * x + y * y - s * s
    best, nx, ny, nz = math.inf, 0.0, 0.0, 1.0
    root = b * b - a * c
    if root >= 0.0 and a != 0.0:
        t = (-b - math.sqrt(root)) / a
        if t >= start and abs(z + t * w) <= hz and s + t * ds >= 0.0:
            best, nx, ny = t, (x + t * u) / hx, (y + t * v) / hy
            nz = lean * (s + t * ds)
    if w != 0.0:
        t = (math.copysign(hz, -w) - z) / w
        radius = g[8] if w < 0.0 else 1.0
        if start <= t < best and (x + t * u) ** 2 + (y + t * v) ** 2 <= radius * radius:
            best, nx, ny, nz = t, 0.0, 0.0, math.copysign(1.0, -w)
    return best, nx, ny, nz


@numba.njit(cache=True, nogil=True)
@no_type_check
def intersect_wheel(g, x, y, z, u, v, w, start):
    """Entry into a ring with its axis along y."""
    radius, half, hole = g[5], g[6], g[5] * g[8] if g[8] < 1.0 else 0.0
    best, nx, ny, nz = math.inf, 0.0, 0.0, 1.0
    if v != 0.0:
        t = (math.copysign(half, -v) - y) / v
        r = (x + t * u) ** 2 + (z + t * w) ** 2
        if t >= start and hole * hole <= r <= radius * radius:
            best, nx, ny, nz = t, 0.0, math.copysign(1.0, -v), 0.0
    a, b = u * u + w * w, x * u + z * w
    for inside in range(2):
        size = hole if inside else radius
        root = b * b - a * (x * x + z * z - size * size)
        if root >= 0.0 and a > 0.0 and size > 0.0:
            t = (-b + math.sqrt(root)) / a if inside else (-b - math.sqrt(root)) / a
            if start <= t < best and abs(y + t * v) <= half:
                sign = -1.0 if inside else 1.0
                best, nx, ny, nz = t, sign * (x + t * u), 0.0, sign * (z + t * w)
    return best, nx, ny, nz


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def span_ellipsoid(g, x, y, z, u, v, w):
    """Distances at which a ray enters and leaves an ellipsoid; infinite if it misses."""
    x, y, z, u, v, w = x / g[5], y / g[6], z / g[7], u / g[5], v / g[6], w / g[7]
    a, b, c = u * u + v * v + w * w, x * u + y * v + z * w, x * x + y * y + z * z - 1.0
    root = b * b - a * c
    if root < 0.0:
        return math.inf, -math.inf
    root = math.sqrt(root)
    return (-b - root) / a, (-b + root) / a


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def slab(o, d, half, near, far):
    if d == 0.0:
        return (near, far) if abs(o) <= half else (math.inf, -math.inf)
    t0, t1 = (-half - o) / d, (half - o) / d
    return max(near, min(t0, t1)), min(far, max(t0, t1))
