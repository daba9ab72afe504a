"""What synthetic streets are like: class frequencies, and whether pictures and voxels agree."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Int, UInt8

from occdetr.classes import IGNORE
from occdetr.data.stopwatch import Stopwatch
from occdetr.geometry.raycast import camera_rays, cast_rays, metres_to_voxels
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE
from occdetr.streets.ground import surfaces_at
from occdetr.streets.moment import Camera, Moment, World
from occdetr.streets.render import View
from occdetr.streets.scan import Scan
from occdetr.streets.trace import GROUND, NOTHING

AGREEMENT_RANGE = 40.0  # metres
_LARGEST_MARGIN = 48  # pixels: silhouettes nearer than about 3 m get no wider


@dataclass(frozen=True)
class Agreement:
    """Numbers of pixels that see a surface inside the grid and nearer than ``AGREEMENT_RANGE``.

    ``pixels``: all of them but silhouettes; ``same``: of these, pixels whose class is that of the
    first voxel on their ray, in the grid of all surfaces; ``known`` and ``known_same``: the same
    in the label files, where the ray comes to a label before it comes to an unknown voxel.
    """

    silhouettes: int
    pixels: int
    same: int
    known: int
    known_same: int


@dataclass(frozen=True)
class WorldSurvey:
    """One frame: its voxels by class (``[0]`` empty), shares of the grid, and seconds by part."""

    counts: Int[np.ndarray, " 20"]
    occupied: float
    valid: float
    agreement: Agreement
    seconds: dict[str, float]
    image: UInt8[np.ndarray, "height width 3"] = field(repr=False)
    scan: Scan = field(repr=False)


def survey_world(seed: int, split: int, index: int, camera: Camera) -> WorldSurvey:
    """Make the first frame of a world, and look at it. Seconds: ``world``, ``picture`` (with its
    rays), ``voxels``, ``sweeps``."""
    watch = Stopwatch()
    moment = World(seed, split, index).moment()
    watch.lap("world")
    view = moment.view(camera)
    image = moment.picture(view)
    watch.lap("picture")
    voxels = moment.voxels()
    watch.lap("voxels")
    scan = moment.sweep(voxels)
    watch.lap("sweeps")
    return WorldSurvey(
        counts=np.bincount(scan.labels.ravel(), minlength=20),
        occupied=float((scan.labels > 0).mean()),
        valid=float((~scan.invalid).mean()),
        agreement=compare_pixels(moment, view, camera, voxels.classes, scan),
        seconds=watch.seconds,
        image=image,
        scan=scan,
    )


def pixel_classes(moment: Moment, view: View) -> UInt8[np.ndarray, " pixel"]:
    """The class of the surface that each pixel sees, 0 for the sky."""
    hits, scene = view.hits, moment.world.scene
    classes = np.zeros(len(hits.solids), dtype=np.uint8)
    on_solid, on_ground = hits.solids >= 0, hits.solids == GROUND
    classes[on_solid] = moment.solids.classes[hits.solids[on_solid]]
    surfaces = surfaces_at(_points(view)[on_ground], scene.plan)
    classes[on_ground] = scene.palette.classes[surfaces]
    return classes


def compare_pixels(
    moment: Moment,
    view: View,
    camera: Camera,
    surfaces: UInt8[np.ndarray, "256 256 32"],
    scan: Scan,
) -> Agreement:
    """Whether pixels and voxels agree, silhouettes of one voxel's width apart."""
    classes, size = pixel_classes(moment, view), view.image_size
    inside = (_points(view) - moment.pose[:3, 3]) @ moment.pose[:3, :3] - GRID_ORIGIN
    counted = ((inside >= 0) & (inside < np.array(GRID_SHAPE) * VOXEL_SIZE)).all(axis=1)
    counted &= (view.hits.solids != NOTHING) & (view.hits.distances < AGREEMENT_RANGE)
    focal = camera.calibration.projection[0, 0]
    depth = view.hits.distances.reshape(size)
    edges = silhouettes(classes.reshape(size), depth, float(focal)).ravel()
    pixels = counted & ~edges
    first_of_all = _first_classes(camera, surfaces > 0, surfaces)
    labels = np.where(scan.invalid, np.uint8(IGNORE), scan.labels)
    first = _first_classes(camera, labels > 0, labels)
    known = pixels & (first != IGNORE)
    return Agreement(
        silhouettes=int((counted & edges).sum()),
        pixels=int(pixels.sum()),
        same=int((pixels & (first_of_all == classes)).sum()),
        known=int(known.sum()),
        known_same=int((known & (first == classes)).sum()),
    )


def silhouettes(
    classes: UInt8[np.ndarray, "height width"], depth: np.ndarray, focal: float
) -> Bool[np.ndarray, "height width"]:
    """Pixels not farther from a boundary between classes than one voxel's width there.

    The nearer of the two surfaces counts; ``depth`` in metres, ``focal`` in pixels.
    """
    margin = np.zeros(classes.shape)
    for axis in range(2):
        ahead, behind = [slice(None)] * 2, [slice(None)] * 2
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        one, other = tuple(ahead), tuple(behind)
        near = np.minimum(depth[one], depth[other])
        width = np.where(classes[one] != classes[other], focal * VOXEL_SIZE / near, 0)
        margin[one] = np.maximum(margin[one], width)
        margin[other] = np.maximum(margin[other], width)
    margin = np.minimum(np.ceil(margin), _LARGEST_MARGIN).astype(int)
    result = np.zeros(classes.shape, dtype=bool)
    for width in np.unique(margin[margin > 0]):
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(width) + 1,) * 2)
        result |= cv2.dilate((margin == width).astype(np.uint8), disc) > 0
    return result


def _points(view: View) -> np.ndarray:
    """Where each pixel's ray ends (its start, if it meets nothing), metres in the world frame."""
    distances = np.where(view.hits.solids == NOTHING, 0.0, view.hits.distances)
    return view.origins + distances[:, None] * view.directions


def _first_classes(camera: Camera, stops: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """The class of the first voxel on each pixel's ray at which ``stops``; 0 if there is none."""
    calibration = camera.calibration
    projections = calibration.projection, calibration.lidar_to_camera
    origins, directions = camera_rays(*projections, camera.image_size)
    voxels, _, _ = cast_rays(stops, metres_to_voxels(origins), directions)
    found = classes[tuple(np.maximum(voxels, 0).T)]
    return np.where(voxels[:, 0] >= 0, found, 0)
