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
from occdetr.data.stopwatch import Stopwatch
from occdetr.errors import InputError
from occdetr.geometry.camera import MIN_DEPTH, crop_projection, transform_points
from occdetr.geometry.raycast import camera_rays, cast_rays
from occdetr.geometry.voxels import (
    GRID_ORIGIN,
    VOXEL_SIZE,
    metres_to_voxels,
    voxels_to_box,
)

#: Part of the cache key: raise it whenever the same input would give other objects.
OBJECTS_VERSION = 3

DISTANCES: dict[str, float] = {"default": 1.0, "car": 0.6, "person": 0.45, "pole": 0.6}
MIN_VOXELS: dict[str, int] = {
    "default": 10,
    **dict.fromkeys(("bicycle", "motorcycle", "person", "bicyclist", "motorcyclist"), 5),
    **dict.fromkeys(("pole", "traffic-sign"), 5),
}
MIN_BOX_PIXELS = 1.0  # a thinner box is no box
MIN_SHARE_IN_VIEW = 0.1  # of an object's voxels; of less the picture shows a sliver at its border
MAX_IMAGE_SHARE = 0.95  # of the image's area; a larger box says nothing about where


@dataclass(frozen=True)
class ObjectSettings:
    """How objects are made from labels.

    ``classes``: the semantic ids that are objects; none at all is the ``all_background`` partition.
    ``distance``: metres between the centres of two voxels up to which they belong together, and
    ``min_voxels``: voxels below which a cluster is noise; both by class name, over the tables of
    this module, or instead of them if ``default`` says what the other classes have.
    ``ray_stride``: one ray for each square of so many pixels. ``min_visible_pixels``: an object
    that fewer rays hit is dropped.
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
    merged = dict(given) if "default" in given else {**defaults, **given}
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
    watch: Stopwatch | None = None,
) -> SceneObjects:
    """The objects of a frame that the camera sees.

    ``image_size`` is (height, width) of the image that ``calibration`` belongs to. ``watch`` gets
    the laps "clustering", "visibility" (ray casting) and "boxes".
    """
    watch = watch or Stopwatch()
    clusters = cluster_voxels(
        labels, settings.classes, settings.distance_table(), settings.min_voxels_table()
    )
    watch.lap("clustering")
    return see_clusters(labels, clusters, calibration, image_size, settings, watch)


def see_clusters(
    labels: UInt8[NDArray, "x y z"],
    clusters: Clusters,
    calibration: Calibration,
    image_size: tuple[int, int],
    settings: ObjectSettings,
    watch: Stopwatch | None = None,
) -> SceneObjects:
    """Those clusters of a frame that a camera with images of ``image_size`` sees, as objects.

    An object's 2D box bounds those projections of its voxels (all 8 corners, hidden voxels too)
    that fall into the image; voxels with a corner nearer to the camera plane than ``MIN_DEPTH`` are
    left out. Dropped are clusters that no ray hits, behind the camera, thinner than
    ``MIN_BOX_PIXELS``, over more than ``MAX_IMAGE_SHARE`` of the image, or with less than
    ``MIN_SHARE_IN_VIEW`` of their voxels in it.
    """
    watch = watch or Stopwatch()
    if len(clusters.classes) == 0:
        return empty_objects()
    bounds, in_view = _image_bounds(clusters, calibration, image_size)
    size = bounds[:, 2:] - bounds[:, :2]  # pixels; negative where nothing is in view
    candidates = (size >= MIN_BOX_PIXELS).all(1) & (in_view >= MIN_SHARE_IN_VIEW)
    candidates &= size.prod(1) <= MAX_IMAGE_SHARE * image_size[0] * image_size[1]
    watch.lap("boxes")
    seen, alone = _count_rays(
        labels, clusters, candidates, bounds, calibration, image_size, settings
    )
    watch.lap("visibility")
    keep = candidates & (seen >= settings.min_visible_pixels)
    boxes = np.concatenate([(bounds[:, :2] + bounds[:, 2:]) / 2, size], axis=1)
    boxes /= np.array([image_size[1], image_size[0]] * 2)
    grid_boxes = np.stack([voxels_to_box(voxels) for voxels in clusters.split()])
    new_index = np.where(keep, np.cumsum(keep) - 1, -1)
    chosen = keep[clusters.owner]
    objects = SceneObjects(
        classes=clusters.classes[keep].astype(np.int64),
        boxes_cxcywh=boxes[keep].astype(np.float32),
        boxes3d_camera=boxes3d_to_camera(grid_boxes[keep], calibration.lidar_to_camera),
        boxes3d_grid=grid_boxes[keep].astype(np.float32),
        voxels=clusters.voxels[chosen],
        voxel_object=new_index[clusters.owner[chosen]].astype(np.int32),
        visible_fraction=(seen[keep] / np.maximum(alone[keep], 1)).astype(np.float32),
    )
    watch.lap("boxes")
    return objects


def _image_bounds(
    clusters: Clusters, calibration: Calibration, image_size: tuple[int, int]
) -> tuple[Float[NDArray, "cluster 4"], Float[NDArray, " cluster"]]:
    """Bounds of each cluster's part in the image, xyxy in pixels from the image's upper left corner
    (the outer edge of the first pixel, not its centre), and the share of its voxels whose centres
    are in the image."""
    to_grid_metres = np.eye(4)
    to_grid_metres[:3, :3] *= VOXEL_SIZE
    to_grid_metres[:3, 3] = GRID_ORIGIN
    matrix = calibration.projection @ calibration.lidar_to_camera @ to_grid_metres
    bounds = np.full((len(clusters.classes), 4), np.inf)
    bounds[:, 2:] = -np.inf
    height, width = image_size
    inside = np.zeros(len(bounds))
    _bound(clusters.voxels, clusters.owner, matrix, float(height), float(width), bounds, inside)
    bounds[np.isinf(bounds).any(1)] = 0.0
    return bounds, inside / np.bincount(clusters.owner, minlength=len(bounds))


@numba.njit(cache=True, nogil=True)
@no_type_check  # jaxtyping's import hook would hide it from numba
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


def _count_rays(
    labels: UInt8[NDArray, "x y z"],
    clusters: Clusters,
    candidates: NDArray[np.bool_],
    bounds: Float[NDArray, "cluster 4"],
    calibration: Calibration,
    image_size: tuple[int, int],
    settings: ObjectSettings,
) -> tuple[Int[NDArray, " cluster"], Int[NDArray, " cluster"]]:
    """Rays that hit each candidate first, and rays that would if nothing else existed.

    Only rays through its box can hit a candidate, and only those that would hit it alone are cast
    through the whole world, which takes the time: few of the rays of an image.
    """
    seen = np.zeros(len(clusters.classes), np.int64)
    alone = np.zeros(len(clusters.classes), np.int64)
    occupied = (labels != 0) & (labels != IGNORE)
    for index, voxels in enumerate(clusters.split()):
        if not candidates[index]:
            continue
        origins, directions = _rays_through(
            bounds[index], calibration, image_size, settings.ray_stride
        )
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
    bounds: Float[NDArray, " 4"],
    calibration: Calibration,
    image_size: tuple[int, int],
    stride: int,
) -> tuple[Float[NDArray, "ray 3"], Float[NDArray, "ray 3"]]:
    """Origins (voxel units) and directions of those of the image's rays whose block of pixels
    meets the ``bounds`` (xyxy in pixels)."""
    left, top = (bounds[:2] // stride * stride).astype(int).tolist()
    right, bottom = (np.ceil(bounds[2:] / stride) * stride).astype(int).tolist()
    size = (min(bottom, image_size[0]) - top, min(right, image_size[1]) - left)
    projection = crop_projection(calibration.projection, left, top)
    origins, directions = camera_rays(projection, calibration.lidar_to_camera, size, stride)
    return metres_to_voxels(origins), directions


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
