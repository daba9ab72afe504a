"""Exact ray casting through a voxel grid (Amanatides and Woo 1987), compiled with numba.

Rays are in *voxel units*: voxel (i, j, k) is the half-open cube [i, i+1) x [j, j+1) x [k, k+1).
``occdetr.geometry.voxels.metres_to_voxels`` converts points; directions are the same in both units,
since voxels are cubes. The compiled functions release the global interpreter lock, so they may run
in threads. They are marked ``no_type_check`` because numba cannot compile what jaxtyping's import
hook wraps.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, Int8, Int32, Shaped, UInt8

from occdetr.geometry.camera import Camera

# Outward normal of each face code, axis * 2 + (1 for the face on the positive side).
FACE_NORMALS = np.array(
    [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], dtype=np.float32
)


def camera_rays(
    camera: Camera, stride: int = 1
) -> tuple[Float[np.ndarray, "ray 3"], Float[np.ndarray, "ray 3"]]:
    """Origins and unit directions of the rays through an image, in the LiDAR frame, metres.

    The rays are in row-major order. With ``stride`` s there is one ray for each block of s x s
    pixels, through the centre of the block; incomplete blocks at the right and bottom border have
    none. The fourth column of the projection moves the origin. NumPy arrays without batch axes.
    """
    height, width = camera.image_size
    middle = (stride - 1) / 2
    u = np.arange(width // stride) * stride + middle
    v = np.arange(height // stride) * stride + middle
    pixels = np.stack(np.broadcast_arrays(u[None, :], v[:, None], 1.0), axis=-1).reshape(-1, 3)

    projection = np.asarray(camera.projection)
    inverse = np.linalg.inv(np.asarray(projection, dtype=np.float64)[:, :3])
    camera_to_lidar = np.linalg.inv(np.asarray(camera.lidar_to_camera, dtype=np.float64))
    rotation, translation = camera_to_lidar[:3, :3], camera_to_lidar[:3, 3]
    directions = pixels @ (rotation @ inverse).T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    center = rotation @ (-inverse @ projection[:, 3]) + translation
    return np.broadcast_to(center, directions.shape).copy(), directions


def cast_rays(
    occupied: Shaped[np.ndarray, "x y z"],
    origins: Float[np.ndarray, "ray 3"],
    directions: Float[np.ndarray, "ray 3"],
    max_distance: float = math.inf,
) -> tuple[Int32[np.ndarray, "ray 3"], Float32[np.ndarray, " ray"], Int8[np.ndarray, " ray"]]:
    """The first occupied voxel on each ray, by exact traversal.

    ``occupied`` is bool or uint8, nonzero where rays stop. Origins are in voxel units and may be
    outside the grid; directions need not be unit vectors. Distances, including ``max_distance``,
    are Euclidean and in voxel units.

    Returns the voxel that is hit (-1, -1, -1: none), the distance at which the ray enters it
    (infinite if none) and the face by which it enters: an index into ``FACE_NORMALS``, axis * 2,
    + 1 for the face on the positive side; -1 without a hit and for rays that start inside an
    occupied voxel.
    """
    grid, origins, directions = _prepare(occupied, origins, directions)
    hits = np.full((len(origins), 3), -1, dtype=np.int32)
    distances = np.full(len(origins), np.inf, dtype=np.float32)
    faces = np.full(len(origins), -1, dtype=np.int8)
    _cast(grid, origins, directions, float(max_distance), hits, distances, faces)
    return hits, distances, faces


def mark_swept(
    occupied: Shaped[np.ndarray, "x y z"],
    origin: Float[np.ndarray, " 3"],
    azimuths: Float[np.ndarray, " column"],
    elevations: Float[np.ndarray, " row"],
    max_distance: float,
    seen: UInt8[np.ndarray, "x y z"],
) -> None:
    """Mark the voxels visible to a laser scanner: set ``seen`` to 1, in place, in the voxels on
    each beam up to and including the first occupied one.

    There is a beam for each pair of an azimuth (radians from x towards y) and an elevation (radians
    from the plane of x and y towards z). Units as in ``cast_rays``.
    """
    unit = np.array([[1.0, 0.0, 0.0]])
    grid, start, _ = _prepare(occupied, np.asarray(origin)[None], unit)
    if seen.shape != grid.shape or seen.dtype != np.uint8:
        raise ValueError(f"seen must be uint8 {grid.shape}, got {seen.dtype} {seen.shape}")
    _mark(grid, start[0], azimuths, elevations, float(max_distance), seen)


def _prepare(
    occupied: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The arrays in the layout and type for which the code is compiled."""
    if occupied.dtype not in (np.bool_, np.uint8):
        raise TypeError(f"occupied must be bool or uint8, got {occupied.dtype}")
    if origins.shape != directions.shape or origins.shape[-1:] != (3,) or origins.ndim != 2:
        raise ValueError(
            f"origins {origins.shape} and directions {directions.shape}: must be (R, 3)"
        )
    directions = np.ascontiguousarray(directions, dtype=np.float64)
    length = np.sqrt(np.einsum("ij,ij->i", directions, directions))[:, None]
    if not (length > 0).all():
        raise ValueError("directions must not be zero or NaN")
    return (
        np.ascontiguousarray(occupied).view(np.uint8),
        np.ascontiguousarray(origins, dtype=np.float64),
        directions / length,
    )


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _enter(o, d, n, near, far):
    """Clip the ray's interval [near, far] to the slab [0, n) of one axis."""
    if d == 0.0:
        if o < 0.0 or o >= n:
            far = -1.0
    elif d > 0.0:
        near, far = max(near, -o / d), min(far, (n - o) / d)
    else:
        near, far = max(near, (n - o) / d), min(far, -o / d)
    return near, far


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _first_index(o, d, n, near):
    """The voxel in which the ray is just after ``near``, on one axis.

    A point on a boundary belongs to the voxel that the ray enters.
    """
    position = o + near * d
    index = math.floor(position)
    if d < 0.0 and position == index:
        index -= 1
    return min(max(index, 0), n - 1)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _face_at_entry(o, d, n, near, axis, face):
    """The face by which a ray from outside enters the grid, if it enters through this axis."""
    if d > 0.0 and near > 0.0 and near == -o / d:
        face = axis * 2
    elif d < 0.0 and near > 0.0 and near == (n - o) / d:
        face = axis * 2 + 1
    return face


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _step_of(d):
    """(index step, offset of the next boundary, 1 / d) of one axis."""
    if d > 0.0:
        return 1, 1, 1.0 / d
    if d < 0.0:
        return -1, 0, 1.0 / d
    return 0, 0, 0.0


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _boundary(index, offset, o, inverse):
    """Distance to the next boundary, from the integer index, so that errors do not accumulate."""
    return (index + offset - o) * inverse if inverse != 0.0 else math.inf


@numba.njit(cache=True, nogil=True)
@no_type_check
def _walk(grid, ox, oy, oz, dx, dy, dz, limit, seen, mark):
    """Walk one ray; (x, y, z, distance, face) of the first occupied voxel, x = -1 if none."""
    nx, ny, nz = grid.shape
    near, far = _enter(ox, dx, nx, 0.0, limit)
    near, far = _enter(oy, dy, ny, near, far)
    near, far = _enter(oz, dz, nz, near, far)
    if near >= far:
        return -1, -1, -1, math.inf, -1
    x = _first_index(ox, dx, nx, near)
    y = _first_index(oy, dy, ny, near)
    z = _first_index(oz, dz, nz, near)
    face = _face_at_entry(ox, dx, nx, near, 0, -1)
    face = _face_at_entry(oy, dy, ny, near, 1, face)
    face = _face_at_entry(oz, dz, nz, near, 2, face)
    step_x, offset_x, inverse_x = _step_of(dx)
    step_y, offset_y, inverse_y = _step_of(dy)
    step_z, offset_z, inverse_z = _step_of(dz)
    next_x = _boundary(x, offset_x, ox, inverse_x)
    next_y = _boundary(y, offset_y, oy, inverse_y)
    next_z = _boundary(z, offset_z, oz, inverse_z)
    distance = near
    while True:
        if mark:
            seen[x, y, z] = 1
        if grid[x, y, z] != 0:
            return x, y, z, distance, face
        if next_x <= next_y and next_x <= next_z:
            distance, face = next_x, (0 if step_x > 0 else 1)
            x += step_x
            if x < 0 or x >= nx:
                break
            next_x = _boundary(x, offset_x, ox, inverse_x)
        elif next_y <= next_z:
            distance, face = next_y, (2 if step_y > 0 else 3)
            y += step_y
            if y < 0 or y >= ny:
                break
            next_y = _boundary(y, offset_y, oy, inverse_y)
        else:
            distance, face = next_z, (4 if step_z > 0 else 5)
            z += step_z
            if z < 0 or z >= nz:
                break
            next_z = _boundary(z, offset_z, oz, inverse_z)
        if distance > limit:
            break
    return -1, -1, -1, math.inf, -1


@numba.njit(cache=True, nogil=True)
@no_type_check
def _cast(grid, origins, directions, limit, hits, distances, faces):
    for ray in range(len(origins)):
        o, d = origins[ray], directions[ray]
        x, y, z, distance, face = _walk(
            grid, o[0], o[1], o[2], d[0], d[1], d[2], limit, grid, False
        )
        if x >= 0:
            hits[ray, 0], hits[ray, 1], hits[ray, 2] = x, y, z
            distances[ray] = distance
            faces[ray] = face


@numba.njit(cache=True, nogil=True)
@no_type_check
def _mark(grid, o, azimuths, elevations, limit, seen):
    for row in range(len(elevations)):
        flat, dz = math.cos(elevations[row]), math.sin(elevations[row])
        for column in range(len(azimuths)):
            dx, dy = flat * math.cos(azimuths[column]), flat * math.sin(azimuths[column])
            _walk(grid, o[0], o[1], o[2], dx, dy, dz, limit, seen, True)
