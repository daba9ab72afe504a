"""Object labels from voxels: clustering, projection, visibility (paper, Section III-A).

Voxels of one foreground class are clustered by distance, "without precisely distinguishing each
object". Each cluster is projected into the image for its 2D box. Clusters without a visible pixel
are dropped. Partly hidden ones keep their full extent, so that the network learns to complete them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32, Int16, Int32, Int64, UInt8
from numpy.typing import NDArray

from occdetr.classes import CLASS_NAMES, FOREGROUND, check_classes, class_ids
from occdetr.data.clusters import Clusters, cluster_voxels
from occdetr.data.stopwatch import Stopwatch
from occdetr.data.visibility import count_rays, image_bounds
from occdetr.errors import COUNT, POSITIVE, InputError, Range, check_each, check_ranges
from occdetr.geometry.boxes import boxes3d_to_camera
from occdetr.geometry.camera import Camera
from occdetr.geometry.voxels import VOXEL_SIZE, voxels_to_box

#: Part of the cache key: increase it whenever the same input gives other objects.
OBJECTS_VERSION = 3

DISTANCES: dict[str, float] = {"default": 1.0, "car": 0.6, "person": 0.45, "pole": 0.6}
MIN_VOXELS: dict[str, int] = {
    "default": 10,
    **dict.fromkeys(("bicycle", "motorcycle", "person", "bicyclist", "motorcyclist"), 5),
    **dict.fromkeys(("pole", "traffic-sign"), 5),
}
RAY_STRIDE = Range(1, 32)  # pixels; a pole is narrower
VISIBLE_PIXELS = Range(1, 10_000)
MIN_BOX_PIXELS = 1.0  # smallest width and height of a 2D box
MIN_SHARE_IN_VIEW = 0.1  # of an object's voxels; drops slivers at the image's border
MAX_IMAGE_SHARE = 0.95  # of the image's area; a larger box does not locate anything


@dataclass(frozen=True)
class ObjectSettings:
    """How objects are made from voxel labels.

    ``classes`` are the semantic ids that are objects (none: the ``all_background`` partition).
    ``distance`` is the largest distance in metres between the centres of two voxels of one object.
    ``min_voxels`` is the smallest number of voxels of an object. Both are by class name and update
    ``DISTANCES`` and ``MIN_VOXELS``; if they have the name ``default``, they replace these tables.
    One ray is cast for each square of ``ray_stride`` pixels, and objects hit by fewer than
    ``min_visible_pixels`` rays are dropped.

    Raises ``InputError`` on unknown classes and on values out of range.
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
                raise InputError(
                    f"data.objects.{name}: unknown class {sorted(unknown)[0]!r}: use class names "
                    "or default"
                )
        check_classes("data.objects.classes", self.classes)
        check_ranges("data.objects", self, ray_stride=RAY_STRIDE, min_visible_pixels=VISIBLE_PIXELS)
        check_each("data.objects.min_voxels", dict(self.min_voxels), COUNT)
        check_each("data.objects.distance", dict(self.distance), POSITIVE)
        if min(self.distance_table()[1:]) < 2 * VOXEL_SIZE:
            raise InputError(
                f"data.objects.distance: give {2 * VOXEL_SIZE} metres or more for each class"
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
    """The objects of one frame in the order of their smallest x; there may be none.

    ``boxes_cxcywh`` are normalised and clipped to the image. 3D boxes are (centre, size) in metres,
    aligned with the axes of the camera or of the grid. ``voxels`` are grid indices (x, y, z), and
    ``voxel_object`` (ascending) is the object of each. ``visible_fraction`` is the share of the
    rays that hit the object first, among those that hit it when no other voxels are there;
    0 < fraction <= 1.
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
    camera: Camera,
    settings: ObjectSettings,
    watch: Stopwatch | None = None,
) -> SceneObjects:
    """The objects of a frame that are visible in the camera's image.

    ``watch`` gets the laps "clustering", "visibility" (ray casting) and "boxes".
    """
    watch = watch or Stopwatch()
    clusters = cluster_voxels(
        labels, settings.classes, settings.distance_table(), settings.min_voxels_table()
    )
    watch.lap("clustering")
    return visible_objects(labels, clusters, camera, settings, watch)


def visible_objects(
    labels: UInt8[NDArray, "x y z"],
    clusters: Clusters,
    camera: Camera,
    settings: ObjectSettings,
    watch: Stopwatch | None = None,
) -> SceneObjects:
    """Those clusters of a frame that are visible in the camera's image, as objects.

    An object's 2D box bounds the projections of the 8 corners of its voxels, hidden voxels
    included, clipped to the image; voxels with a corner nearer to the camera plane than
    ``MIN_DEPTH`` do not count. Dropped are clusters that no ray hits, that are behind the camera,
    narrower or lower than ``MIN_BOX_PIXELS``, larger than ``MAX_IMAGE_SHARE`` of the image, or have
    less than ``MIN_SHARE_IN_VIEW`` of their voxels in it.
    """
    watch = watch or Stopwatch()
    if len(clusters.classes) == 0:
        return empty_objects()
    bounds, in_view = image_bounds(clusters, camera)
    height, width = camera.image_size
    size = bounds[:, 2:] - bounds[:, :2]  # pixels; negative where nothing is in view
    candidates = (size >= MIN_BOX_PIXELS).all(1) & (in_view >= MIN_SHARE_IN_VIEW)
    candidates &= size.prod(1) <= MAX_IMAGE_SHARE * height * width
    watch.lap("boxes")
    seen, alone = count_rays(labels, clusters, candidates, bounds, camera, settings.ray_stride)
    watch.lap("visibility")
    keep = candidates & (seen >= settings.min_visible_pixels)
    boxes = np.concatenate([(bounds[:, :2] + bounds[:, 2:]) / 2, size], axis=1)
    boxes /= np.array([width, height] * 2)
    grid_boxes = np.stack([voxels_to_box(voxels) for voxels in clusters.split()])
    camera_boxes = boxes3d_to_camera(grid_boxes[keep], camera.lidar_to_camera)
    new_index = np.where(keep, np.cumsum(keep) - 1, -1)
    chosen = keep[clusters.owner]
    objects = SceneObjects(
        classes=clusters.classes[keep].astype(np.int64),
        boxes_cxcywh=boxes[keep].astype(np.float32),
        boxes3d_camera=camera_boxes.astype(np.float32),
        boxes3d_grid=grid_boxes[keep].astype(np.float32),
        voxels=clusters.voxels[chosen],
        voxel_object=new_index[clusters.owner[chosen]].astype(np.int32),
        visible_fraction=(seen[keep] / np.maximum(alone[keep], 1)).astype(np.float32),
    )
    watch.lap("boxes")
    return objects
