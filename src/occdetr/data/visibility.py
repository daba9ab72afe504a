"""Visibility of voxel clusters: their bounds in the image and the rays that hit them."""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray

from occdetr.classes import IGNORE
from occdetr.data.clusters import Clusters
from occdetr.geometry.camera import MIN_DEPTH, Camera, crop_camera
from occdetr.geometry.raycast import camera_rays, cast_rays
from occdetr.geometry.voxels import GRID_ORIGIN, VOXEL_SIZE, metres_to_voxels


def image_bounds(
    clusters: Clusters, camera: Camera
) -> tuple[Float[NDArray, "cluster 4"], Float[NDArray, " cluster"]]:
    """Bounds of each cluster's part in the image, and the share of its voxels whose centres are in
    the image.

    Bounds are xyxy in pixels from the image's upper left corner, which is the outer edge of the
    first pixel, not its centre.
    """
    to_grid_metres = np.eye(4)
    to_grid_metres[:3, :3] *= VOXEL_SIZE
    to_grid_metres[:3, 3] = GRID_ORIGIN
    matrix = camera.projection @ camera.lidar_to_camera @ to_grid_metres
    bounds = np.full((len(clusters.classes), 4), np.inf)
    bounds[:, 2:] = -np.inf
    height, width = camera.image_size
    inside = np.zeros(len(bounds))
    _bound(clusters.voxels, clusters.owner, matrix, float(height), float(width), bounds, inside)
    bounds[np.isinf(bounds).any(1)] = 0.0
    return bounds, inside / np.bincount(clusters.owner, minlength=len(bounds))


@numba.njit(cache=True, nogil=True)
@no_type_check  # numba cannot compile what jaxtyping's import hook wraps
def _project(matrix, x, y, z):
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    safe = max(depth, MIN_DEPTH)
    u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / safe
    v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / safe
    return u + 0.5, v + 0.5, depth


@numba.njit(cache=True, nogil=True)
@no_type_check
def _bound(voxels, owner, matrix, height, width, bounds, inside):
    for v in range(len(voxels)):
        left, top, right, bottom, nearest = np.inf, np.inf, -np.inf, -np.inf, np.inf
        for corner in range(8):
            x = voxels[v, 0] + (corner & 1)
            y = voxels[v, 1] + ((corner >> 1) & 1)
            z = voxels[v, 2] + (corner >> 2)
            u, w, depth = _project(matrix, x, y, z)
            nearest = min(nearest, depth)
            if depth <= MIN_DEPTH:
                break
            left, right = min(left, u), max(right, u)
            top, bottom = min(top, w), max(bottom, w)
        if nearest <= MIN_DEPTH or right <= 0 or bottom <= 0 or left >= width or top >= height:
            continue
        u, w, _ = _project(matrix, voxels[v, 0] + 0.5, voxels[v, 1] + 0.5, voxels[v, 2] + 0.5)
        inside[owner[v]] += 0 <= u < width and 0 <= w < height
        box = bounds[owner[v]]
        box[0], box[1] = min(box[0], max(left, 0.0)), min(box[1], max(top, 0.0))
        box[2], box[3] = max(box[2], min(right, width)), max(box[3], min(bottom, height))


def count_rays(
    labels: UInt8[NDArray, "x y z"],
    clusters: Clusters,
    candidates: NDArray[np.bool_],
    bounds: Float[NDArray, "cluster 4"],
    camera: Camera,
    stride: int,
) -> tuple[Int[NDArray, " cluster"], Int[NDArray, " cluster"]]:
    """Numbers of rays that hit each candidate first, and of rays that would without any other
    voxels; 0 for clusters that are no candidates.

    ``bounds`` are those of ``image_bounds``; there is one ray for each square of ``stride`` pixels.
    Rays are cast through a candidate's own voxels first, and only those that hit it are cast
    through the whole grid, which is the slow part.
    """
    seen = np.zeros(len(clusters.classes), np.int64)
    alone = np.zeros(len(clusters.classes), np.int64)
    occupied = (labels != 0) & (labels != IGNORE)
    for index, voxels in enumerate(clusters.split()):
        if not candidates[index]:
            continue
        origins, directions = _rays_through(bounds[index], camera, stride)
        lower, upper = voxels.min(0), voxels.max(0) + 1
        own = np.zeros(upper - lower, dtype=bool)
        own[tuple((voxels - lower).T)] = True
        own_hits, _, _ = cast_rays(own, origins - lower, directions)
        rays = own_hits[:, 0] >= 0
        hits, _, _ = cast_rays(occupied, origins[rays], directions[rays])
        hits = hits[((hits >= lower) & (hits < upper)).all(1)] - lower
        alone[index] = np.count_nonzero(rays)
        seen[index] = np.count_nonzero(own[tuple(hits.T)])
    return seen, alone


def _rays_through(
    bounds: Float[NDArray, " 4"], camera: Camera, stride: int
) -> tuple[Float[NDArray, "ray 3"], Float[NDArray, "ray 3"]]:
    """Origins (voxel units) and directions of those of the image's rays whose block of pixels
    overlaps the ``bounds`` (xyxy in pixels)."""
    left, top = (bounds[:2] // stride * stride).astype(int).tolist()
    right, bottom = (np.ceil(bounds[2:] / stride) * stride).astype(int).tolist()
    height, width = camera.image_size
    size = (min(bottom, height) - top, min(right, width) - left)
    origins, directions = camera_rays(crop_camera(camera, left, top, size), stride)
    return metres_to_voxels(origins), directions
