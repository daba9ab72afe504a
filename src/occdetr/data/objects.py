"""Object labels from voxels: cluster, project, look (paper Section III-A).

Voxels of one foreground class are clustered by distance, "without precisely distinguishing each
object". Each cluster is projected into the image for its 2D box. What no pixel sees is dropped;
what is partly hidden stays, with its whole extent, so that the model learns to complete it.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, Int, Int16, Int32, Int64, UInt8
from numpy.typing import NDArray

from occdetr.classes import CLASS_NAMES, FOREGROUND, IGNORE, NUM_CLASSES, class_ids
from occdetr.data.clusters import Clusters, cluster_voxels
from occdetr.data.semantickitti import Calibration
from occdetr.errors import InputError
from occdetr.geometry.camera import MIN_DEPTH, transform_points
from occdetr.geometry.raycast import camera_rays, cast_rays
from occdetr.geometry.voxels import (
    GRID_ORIGIN,
    VOXEL_SIZE,
    metres_to_voxels,
    voxels_to_box,
)

#: Part of the cache key: raise it whenever the same input would give other objects.
OBJECTS_VERSION = 1

DISTANCES: dict[str, float] = {"default": 1.0}
MIN_VOXELS: dict[str, int] = {
    "default": 10,
    **dict.fromkeys(("bicycle", "motorcycle", "person", "bicyclist", "motorcyclist"), 5),
    **dict.fromkeys(("pole", "traffic-sign"), 5),
}
MIN_BOX_PIXELS = 1.0  # a thinner box is no box
MAX_IMAGE_SHARE = 0.95  # of the image's area; a larger box says nothing about where


@dataclass(frozen=True)
class ObjectSettings:
    """How objects are made from labels.

    ``classes``: the semantic ids that are objects; none at all is the ``all_background`` partition.
    ``distance``: metres between the centres of two voxels up to which they belong together, and
    ``min_voxels``: voxels below which a cluster is noise; both by class name, with ``default`` for
    the other classes, over the tables of this module. ``ray_stride``: one ray for each square of so
    many pixels. ``min_visible_pixels``: an object that fewer rays hit is dropped.
    """

    classes: tuple[int, ...] = class_ids(FOREGROUND)
    distance: Mapping[str, float] = field(default_factory=dict)
    min_voxels: Mapping[str, int] = field(default_factory=dict)
    ray_stride: int = 2
    min_visible_pixels: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", tuple(int(index) for index in self.classes))
        for name in ("distance", "min_voxels"):
            unknown = set(getattr(self, name)) - {"default", *CLASS_NAMES[1:]}
            if unknown:
                raise InputError(f"objects.{name}: unknown class {sorted(unknown)[0]!r}")
        if any(not 0 < index < NUM_CLASSES for index in self.classes):
            raise InputError(f"objects.classes: {self.classes} are not all ids from 1 to 19")
        if min(self.ray_stride, self.min_visible_pixels) < 1:
            raise InputError("objects.ray_stride and objects.min_visible_pixels must be at least 1")
        if min(self.distance_table()[1:]) < 2 * VOXEL_SIZE:
            raise InputError(
                f"objects.distance: use {2 * VOXEL_SIZE} metres or more for each class"
            )

    def distance_table(self) -> Float[NDArray, " class"]:
        """Metres by class id."""
        return _table(DISTANCES, self.distance)

    def min_voxels_table(self) -> Float[NDArray, " class"]:
        """Voxels by class id."""
        return _table(MIN_VOXELS, self.min_voxels)


def _table(defaults: Mapping[str, float], given: Mapping[str, float]) -> NDArray[np.float64]:
    merged = {**defaults, **given}
    return np.array([merged.get(name, merged["default"]) for name in CLASS_NAMES], dtype=np.float64)


@dataclass
class SceneObjects:
    """The objects of one frame, the nearest (smallest x) first; none is normal.

    ``boxes_cxcywh``: normalised, clipped to the image. 3D boxes: (centre, size) in metres, aligned
    with the axes of the camera and of the grid. ``voxels``: grid indices (x, y, z), grouped by
    ``voxel_object``. ``visible_fraction``: of the rays that would hit the object if it stood alone
    in the world, the share that hits it as things are; 0 < fraction <= 1.
    """

    classes: Int64[NDArray, " object"]
    boxes_cxcywh: Float32[NDArray, "object 4"]
    boxes3d_camera: Float32[NDArray, "object 6"]
    boxes3d_grid: Float32[NDArray, "object 6"]
    voxels: Int16[NDArray, "voxel 3"]
    voxel_object: Int32[NDArray, " voxel"]
    visible_fraction: Float32[NDArray, " object"]

    def __len__(self) -> int:
        return len(self.classes)

    def arrays(self) -> dict[str, NDArray]:
        """The fields by name, as they are stored."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}


def empty_objects() -> SceneObjects:
    """The objects of a frame without objects."""
    return SceneObjects(
        classes=np.zeros(0, np.int64),
        boxes_cxcywh=np.zeros((0, 4), np.float32),
        boxes3d_camera=np.zeros((0, 6), np.float32),
        boxes3d_grid=np.zeros((0, 6), np.float32),
        voxels=np.zeros((0, 3), np.int16),
        voxel_object=np.zeros(0, np.int32),
        visible_fraction=np.zeros(0, np.float32),
    )


def extract_objects(
    labels: UInt8[NDArray, "x y z"],
    calibration: Calibration,
    image_size: tuple[int, int],
    settings: ObjectSettings,
) -> SceneObjects:
    """The objects of a frame that the camera sees.

    ``image_size`` is (height, width) of the image that ``calibration`` belongs to. An object's 2D
    box bounds those projections of its voxels (all 8 corners, hidden voxels too) that fall into the
    image; voxels with a corner nearer to the camera plane than ``MIN_DEPTH`` are left out.
    Dropped are clusters that no ray hits, outside the view, behind the camera, thinner than
    ``MIN_BOX_PIXELS``, or over more than ``MAX_IMAGE_SHARE`` of the image.
    """
    clusters = cluster_voxels(
        labels, settings.classes, settings.distance_table(), settings.min_voxels_table()
    )
    if len(clusters.classes) == 0:
        return empty_objects()
    bounds = _image_bounds(clusters, calibration, image_size)
    size = bounds[:, 2:] - bounds[:, :2]  # pixels; negative where nothing is in view
    candidates = (size >= MIN_BOX_PIXELS).all(1)
    candidates &= size.prod(1) <= MAX_IMAGE_SHARE * image_size[0] * image_size[1]
    seen, alone = _count_rays(
        labels, clusters, candidates, bounds, calibration, image_size, settings
    )
    keep = candidates & (seen >= settings.min_visible_pixels)
    boxes = np.concatenate([(bounds[:, :2] + bounds[:, 2:]) / 2, size], axis=1)
    boxes /= np.array([image_size[1], image_size[0]] * 2)
    grid_boxes = np.stack([voxels_to_box(voxels) for voxels in clusters.split()])
    new_index = np.where(keep, np.cumsum(keep) - 1, -1)
    chosen = keep[clusters.owner]
    return SceneObjects(
        classes=clusters.classes[keep].astype(np.int64),
        boxes_cxcywh=boxes[keep].astype(np.float32),
        boxes3d_camera=boxes3d_to_camera(grid_boxes[keep], calibration.lidar_to_camera),
        boxes3d_grid=grid_boxes[keep].astype(np.float32),
        voxels=clusters.voxels[chosen],
        voxel_object=new_index[clusters.owner[chosen]].astype(np.int32),
        visible_fraction=(seen[keep] / np.maximum(alone[keep], 1)).astype(np.float32),
    )


def _image_bounds(
    clusters: Clusters, calibration: Calibration, image_size: tuple[int, int]
) -> Float[NDArray, "cluster 4"]:
    """Bounds of each cluster's part in the image, xyxy in pixels from the image's upper left corner
    (the outer edge of the first pixel, not its centre)."""
    to_grid_metres = np.eye(4)
    to_grid_metres[:3, :3] *= VOXEL_SIZE
    to_grid_metres[:3, 3] = GRID_ORIGIN
    matrix = calibration.projection @ calibration.lidar_to_camera @ to_grid_metres
    bounds = np.full((len(clusters.classes), 4), np.inf)
    bounds[:, 2:] = -np.inf
    height, width = image_size
    _bound(clusters.voxels, clusters.owner, matrix, float(height), float(width), bounds)
    bounds[np.isinf(bounds).any(1)] = 0.0
    return bounds


@numba.njit(cache=True, nogil=True)
@no_type_check  # jaxtyping's import hook would hide it from numba
def _bound(voxels, owner, matrix, height, width, bounds):
    for v in range(len(voxels)):
        left, top, right, bottom, nearest = np.inf, np.inf, -np.inf, -np.inf, np.inf
        for corner in range(8):
            x = voxels[v, 0] + (corner & 1)
            y = voxels[v, 1] + ((corner >> 1) & 1)
            z = voxels[v, 2] + (corner >> 2)
            depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
            nearest = min(nearest, depth)
            if depth <= MIN_DEPTH:
                break
            u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / depth
            w = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / depth
            left, right = min(left, u + 0.5), max(right, u + 0.5)
            top, bottom = min(top, w + 0.5), max(bottom, w + 0.5)
        if nearest <= MIN_DEPTH or right <= 0 or bottom <= 0 or left >= width or top >= height:
            continue
        box = bounds[owner[v]]
        box[0], box[1] = min(box[0], max(left, 0.0)), min(box[1], max(top, 0.0))
        box[2], box[3] = max(box[2], min(right, width)), max(box[3], min(bottom, height))


def _count_rays(
    labels: UInt8[NDArray, "x y z"],
    clusters: Clusters,
    candidates: NDArray[np.bool_],
    bounds: Float[NDArray, "cluster 4"],
    calibration: Calibration,
    image_size: tuple[int, int],
    settings: ObjectSettings,
) -> tuple[Int[NDArray, " cluster"], Int[NDArray, " cluster"]]:
    """Rays that hit each cluster first, and rays that would if nothing else existed."""
    num_clusters, stride = len(clusters.classes), settings.ray_stride
    if not candidates.any():
        return np.zeros(num_clusters, np.int64), np.zeros(num_clusters, np.int64)
    rows, columns = image_size[0] // stride, image_size[1] // stride
    origins, directions = camera_rays(
        calibration.projection, calibration.lidar_to_camera, image_size, stride
    )
    origins = metres_to_voxels(origins)
    hits, _, _ = cast_rays((labels != 0) & (labels != IGNORE), origins, directions)
    first = np.where(hits[:, 0] >= 0, clusters.index_grid[hits[:, 0], hits[:, 1], hits[:, 2]], -1)
    seen = np.bincount(first[first >= 0], minlength=num_clusters)

    alone = seen.copy()
    ray_grid = np.arange(rows * columns).reshape(rows, columns)
    for index, voxels in enumerate(clusters.split()):
        if not candidates[index] or seen[index] == 0:
            continue
        left, top = (bounds[index, :2] // stride).astype(int)
        right, bottom = np.ceil(bounds[index, 2:] / stride).astype(int)
        rays = ray_grid[top:bottom, left:right].ravel()
        rays = rays[first[rays] != index]
        lower = voxels.min(0)
        own = np.zeros(voxels.max(0) - lower + 1, dtype=np.uint8)
        own[tuple((voxels - lower).T)] = 1
        own_hits, _, _ = cast_rays(own, origins[rays] - lower, directions[rays])
        alone[index] += np.count_nonzero(own_hits[:, 0] >= 0)
    return seen, alone


def boxes3d_to_camera(
    boxes: Float[NDArray, "object 6"], lidar_to_camera: Float[NDArray, "4 4"]
) -> Float32[NDArray, "object 6"]:
    """Grid-frame boxes as boxes along the camera's axes, metres.

    The centre is transformed; the size takes each camera axis from the grid axis that it lies
    closest along. So a camera that looks straight ahead or straight aside changes no size, and the
    way back (8 corners, axis-aligned bounds) returns the grid box up to the camera's small tilt.
    """
    rotation = np.abs(lidar_to_camera[:3, :3])
    axes = max(itertools.permutations(range(3)), key=lambda p: rotation[np.arange(3), p].sum())
    center = transform_points(boxes[:, :3], lidar_to_camera)
    return np.concatenate([center, boxes[:, 3:][:, axes]], axis=1).astype(np.float32)
