"""Whether the pixels and the voxels of a street agree."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from occdetr.classes import IGNORE
from occdetr.geometry.camera import Camera
from occdetr.geometry.raycast import camera_rays, cast_rays
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE, VOXEL_SIZE, metres_to_voxels
from occdetr.streets.ground import surfaces_at
from occdetr.streets.render import View
from occdetr.streets.scan import Scan
from occdetr.streets.trace import GROUND, NOTHING
from occdetr.streets.world import Snapshot

AGREEMENT_RANGE = 40.0  # metres
_LARGEST_MARGIN = 48  # pixels; limits the width of silhouettes nearer than about 3 m


@dataclass(frozen=True)
class Agreement:
    """Numbers of pixels that show a surface inside the grid and nearer than ``AGREEMENT_RANGE``.

    ``silhouettes`` are pixels near a boundary between classes and ``pixels`` all others. ``same``
    counts those of them whose class is that of the first voxel on their ray, in the grid of all
    surfaces. ``known`` counts those whose ray meets a labelled voxel before an unknown one in the
    label files, ``known_same`` those of them with the same class.
    """

    silhouettes: int
    pixels: int
    same: int
    known: int
    known_same: int


def pixel_classes(snapshot: Snapshot, view: View) -> UInt8[np.ndarray, " pixel"]:
    """The class of the surface that each pixel shows, 0 for the sky."""
    hits, scene = view.hits, snapshot.world.scene
    classes = np.zeros(len(hits.solids), dtype=np.uint8)
    on_solid, on_ground = hits.solids >= 0, hits.solids == GROUND
    classes[on_solid] = snapshot.solids.classes[hits.solids[on_solid]]
    surfaces = surfaces_at(_points(view)[on_ground], scene.plan)
    classes[on_ground] = scene.palette.classes[surfaces]
    return classes


def compare_pixels(
    snapshot: Snapshot,
    view: View,
    camera: Camera,
    surfaces: UInt8[np.ndarray, "256 256 32"],
    scan: Scan,
) -> Agreement:
    """Compare the classes of pixels with those of voxels, except near silhouettes.

    ``surfaces`` are the classes of all voxels with a surface, ``scan`` the label files.
    """
    classes, size = pixel_classes(snapshot, view), view.image_size
    inside = (_points(view) - snapshot.pose[:3, 3]) @ snapshot.pose[:3, :3] - GRID_ORIGIN
    counted = ((inside >= 0) & (inside < np.array(GRID_SHAPE) * VOXEL_SIZE)).all(axis=1)
    counted &= (view.hits.solids != NOTHING) & (view.hits.distances < AGREEMENT_RANGE)
    focal = camera.projection[0, 0]
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
    """Pixels whose distance from a boundary between classes is at most one voxel.

    The voxel's width in pixels is that at the nearer of the two surfaces; ``depth`` in metres,
    ``focal`` length in pixels.
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
    """The end of each pixel's ray (its origin, if it hits nothing), metres in the world frame."""
    distances = np.where(view.hits.solids == NOTHING, 0.0, view.hits.distances)
    return view.origins + distances[:, None] * view.directions


def _first_classes(camera: Camera, stops: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """The class of the first voxel in ``stops`` on each pixel's ray; 0 if there is none."""
    origins, directions = camera_rays(camera)
    voxels, _, _ = cast_rays(stops, metres_to_voxels(origins), directions)
    found = classes[tuple(np.maximum(voxels, 0).T)]
    return np.where(voxels[:, 0] >= 0, found, 0)
