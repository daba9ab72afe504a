"""The pictures that a network gets of an image: views of the camera that it was trained with.

An image of another camera is not squeezed into the network's size. It is warped to virtual cameras
that stand where the real one stands, level, and with the field of view of the training's: one, or
several side by side where the image shows more. What they predict is put together in the grid of
the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped, UInt8
from numpy.typing import NDArray

from occdetr.api.camera import Camera
from occdetr.data.images import resize_picture
from occdetr.errors import InputError
from occdetr.geometry import camera as pinhole
from occdetr.geometry.boxes import boxes3d_to_grid
from occdetr.geometry.kitti import kitti_camera
from occdetr.geometry.voxels import GRID_SHAPE, points_to_indices, voxel_centers

#: Largest shift of a pixel, as a share of the image's width, up to which an image is resized only.
SAME_VIEW = 0.02
#: An image up to this many times as wide as the training's is one view, whose sides are cut off.
ONE_VIEW = 1.2
MOST_VIEWS = 5
STEEPEST = 60.0  # degrees that a camera may look up or down
GRAY = (124, 116, 104)  # ImageNet's mean, where an image has no pixel


@dataclass(frozen=True)
class View:
    """A picture for the network, and how it is placed.

    Attributes:
        image: RGB in the network's size.
        camera: its pinhole camera, in the view's own grid frame.
        to_vehicle: the 4 x 4 transform from the view's grid frame to the vehicle's.
        seen: the pixels that the image has; None: all.
        source: where each pixel lies in the image (u, v); None: the image was only resized.
    """

    image: UInt8[NDArray, "height width 3"]
    camera: pinhole.Camera
    to_vehicle: Float[NDArray, "4 4"]
    seen: Bool[NDArray, "height width"] | None = None
    source: Float[NDArray, "height width 2"] | None = None


def make_views(
    image: UInt8[NDArray, "height width 3"], camera: Camera, image_size: tuple[int, int]
) -> list[View]:
    """The views of an image for a network of ``image_size`` (height, width), the middle one first.

    Raises ``InputError`` if the image is too small, the camera is for other images, or it looks too
    far up or down.
    """
    size = (image.shape[0], image.shape[1])
    if min(size) < pinhole.MIN_IMAGE_SIDE:
        raise InputError(
            f"image is too small: {size[1]} x {size[0]} pixels: give {pinhole.MIN_IMAGE_SIDE} or "
            "more in both directions"
        )
    camera = camera.for_image(size)
    trained = kitti_camera(image_size)
    forward = camera.grid_to_camera[2, :3]
    if abs(math.degrees(math.asin(np.clip(forward[2], -1, 1)))) > STEEPEST:
        raise InputError(
            f"the camera looks up or down by more than {STEEPEST:g} degrees: the network knows "
            "cameras that look ahead"
        )
    ahead = trained.lidar_to_camera[2, :3]  # KITTI's camera looks a little to the side
    heading = math.atan2(forward[1], forward[0]) - math.atan2(ahead[1], ahead[0])
    views = []
    for turn in _turns(camera, trained, heading):
        source, seen = _source(camera, trained, heading + turn)
        if turn == 0.0 and abs(heading) < 0.01 and _is_resized(source, image, image_size):
            return [_resized(image, camera, image_size)]
        assert camera.projection is not None
        if camera.projection[0, 1] or camera.projection[1, 0]:
            raise InputError("the camera's intrinsics have a skew, which is not known here")
        picture = _warp(image, source, seen)
        to_vehicle, view_camera = _place(camera.centered(), trained, heading + turn)
        views.append(View(picture, view_camera, to_vehicle, seen, source))
    return views


def _resized(
    image: UInt8[NDArray, "height width 3"], camera: Camera, image_size: tuple[int, int]
) -> View:
    """The whole image with its own camera, as the training's data sets have it."""
    assert camera.projection is not None
    size = (image.shape[0], image.shape[1])
    own = pinhole.Camera(camera.projection, camera.grid_to_camera, size)
    return View(*resize_picture(image, own, image_size), np.eye(4))


def _turns(camera: Camera, trained: pinhole.Camera, heading: float) -> list[float]:
    """Angles of the views from the camera's heading, in radians to the left; the middle first."""
    height, width = trained.image_size
    focal = trained.projection[0, 0]
    own = 2 * math.atan(0.5 * width / focal)
    lowest = math.atan(0.5 * height / trained.projection[1, 1])
    angles = np.radians(np.arange(-130, 131))
    elevations = np.radians(np.arange(-math.degrees(lowest), math.degrees(lowest), 0.5))
    turn, up = np.meshgrid(heading + angles, elevations, indexing="ij")
    rays = np.stack([np.cos(turn) * np.cos(up), np.sin(turn) * np.cos(up), np.sin(up)], axis=-1)
    _, seen = camera.project(rays @ camera.grid_to_camera[:3, :3].T)
    shown = angles[seen.any(1)]
    if not len(shown):
        raise InputError("the image shows nothing at the height of the horizon: turn the camera")
    first, last = float(shown[0]), float(shown[-1])
    if last - first <= ONE_VIEW * own:
        return [0.0]
    number = min(2 * (math.ceil((last - first) / own) // 2) + 1, MOST_VIEWS)  # odd: one is ahead
    turns = np.linspace(first + own / 2, last - own / 2, number)
    middle = float(turns[number // 2])
    return sorted(turns.tolist(), key=lambda turn: abs(turn - middle))


def _source(
    camera: Camera, trained: pinhole.Camera, direction: float
) -> tuple[Float[NDArray, "height width 2"], Bool[NDArray, "height width"]]:
    """Where the pixels of the view in a ``direction`` lie in the image, and which do."""
    height, width = trained.image_size
    v, u = np.mgrid[:height, :width].astype(np.float64)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(trained.projection[:, :3]).T
    level = rays @ trained.lidar_to_camera[:3, :3]  # in the view's grid frame
    ahead = level @ _turn(direction)[:3, :3].T
    return camera.project(ahead @ camera.grid_to_camera[:3, :3].T)


def _is_resized(
    source: Float[NDArray, "height width 2"],
    image: UInt8[NDArray, "image_height image_width 3"],
    image_size: tuple[int, int],
) -> bool:
    """Whether a view is nearly the resized image."""
    scale = np.array([image.shape[1] / image_size[1], image.shape[0] / image_size[0]])
    v, u = np.mgrid[: image_size[0], : image_size[1]]
    plain = (np.stack([u, v], axis=-1) + 0.5) * scale - 0.5
    return bool(np.abs(source - plain).max() <= SAME_VIEW * image.shape[1])


def _warp(
    image: UInt8[NDArray, "height width 3"],
    source: Float[NDArray, "view_height view_width 2"],
    seen: Bool[NDArray, "view_height view_width"],
) -> UInt8[NDArray, "view_height view_width 3"]:
    """The pixels of ``source``; the image is first shrunk to about the view's resolution."""
    rows, columns = seen.shape
    middle = source[rows // 4 : -rows // 4, columns // 4 : -columns // 4]
    step = float(np.nanmedian(np.linalg.norm(np.diff(middle, axis=1), axis=-1)))
    if step > 1:
        size = (max(1, round(image.shape[1] / step)), max(1, round(image.shape[0] / step)))
        scale = np.array([size[0] / image.shape[1], size[1] / image.shape[0]])
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        source = (source + 0.5) * scale - 0.5
    warped = _sample(image, np.nan_to_num(source, nan=-1.0))  # not seen
    return np.where(seen[..., None], warped, np.array(GRAY, np.uint8))


def _sample(
    values: Shaped[NDArray, "height width channel"], places: Float[NDArray, "row column 2"]
) -> Shaped[NDArray, "row column channel"]:
    """``values`` at the places (u, v), bilinear; the border is repeated outside."""
    u, v = np.moveaxis(places.astype(np.float32), -1, 0)
    border = cv2.BORDER_REPLICATE
    return cv2.remap(values, u.copy(), v.copy(), cv2.INTER_LINEAR, borderMode=border)


def _place(
    camera: Camera, trained: pinhole.Camera, direction: float
) -> tuple[Float[NDArray, "4 4"], pinhole.Camera]:
    """The transform from a view's grid frame to the vehicle's, and the view's camera.

    In its own frame a view stands as the training's camera does, but for its height.
    """
    center = np.linalg.inv(camera.grid_to_camera)[:3, 3]
    own = np.linalg.inv(trained.lidar_to_camera)[:3, 3]
    own[2] = center[2]
    rotation = trained.lidar_to_camera[:3, :3]
    extrinsics = np.eye(4)
    extrinsics[:3, :3], extrinsics[:3, 3] = rotation, -rotation @ own
    projection = np.concatenate([trained.projection[:, :3], np.zeros((3, 1))], axis=1)
    to_vehicle = _turn(direction)
    to_vehicle[:3, 3] = center - to_vehicle[:3, :3] @ own
    return to_vehicle, pinhole.Camera(projection, extrinsics, trained.image_size)


def _turn(angle: float) -> Float[NDArray, "4 4"]:
    """A rotation about the vertical axis, to the left."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return matrix


# ---------------------------------------------------------------------- back from the views


def voxel_sources(views: Sequence[View], camera: Camera) -> list[VoxelSource] | None:
    """For each view the voxels of the vehicle's grid that it gives, and its own voxels there.

    A voxel is given by the first view that sees its centre. One that the ``camera`` of the image
    sees and no view does, as the ground near to a high camera, is given by the first view that
    looks in its direction, above or below it, else by the first that has it in its grid. None: the
    image was only resized, so that its grid is the vehicle's, also outside of its field of view.
    """
    if views[0].source is None:
        return None
    centers = voxel_centers(np.argwhere(np.ones(GRID_SHAPE, dtype=bool)))
    free, sources = np.ones(len(centers), dtype=bool), []
    for rule in (_sees, _faces, _has):
        if rule is _faces:
            left = np.flatnonzero(free)
            rays = pinhole.transform_points(centers[left], camera.centered().grid_to_camera)
            free[left] = camera.project(rays)[1]
        for number, view in enumerate(views):
            left = np.flatnonzero(free)
            points = pinhole.transform_points(centers[left], np.linalg.inv(view.to_vehicle))
            index = points_to_indices(points)
            inside = ((index >= 0) & (index < GRID_SHAPE)).all(1)
            inside &= rule(view, points)
            free[left[inside]] = False
            own = np.asarray(np.ravel_multi_index(tuple(index[inside].T), GRID_SHAPE))
            sources.append(VoxelSource(number, left[inside], own))
    return sources


@dataclass(frozen=True)
class VoxelSource:
    """Flat indices of voxels of the vehicle's grid, and of those of a view, by its number."""

    number: int
    vehicle: Integer[NDArray, " voxel"]
    view: Integer[NDArray, " voxel"]


def merge_grids(
    sources: Sequence[VoxelSource] | None, grids: Sequence[Shaped[NDArray, "x y z"]], unseen: float
) -> Shaped[NDArray, "x y z"]:
    """The grid of the vehicle from those of the views; ``unseen`` where none gives a voxel."""
    if sources is None:
        return grids[0]
    merged = np.full(GRID_SHAPE, unseen, dtype=grids[0].dtype)
    for source in sources:
        merged.flat[source.vehicle] = grids[source.number].flat[source.view]
    return merged


def _sees(view: View, points: Float[NDArray, "point 3"]) -> Bool[NDArray, " point"]:
    """Which points of a view's grid frame it has a pixel of, visible or hidden."""
    place = pinhole.transform_points(points, view.camera.lidar_to_camera)
    pixels, depth = pinhole.project_points(place, view.camera.projection)
    column, row = np.rint(pixels).astype(np.int64).T
    height, width = view.camera.image_size
    inside = (depth > pinhole.MIN_DEPTH) & (row >= 0) & (row < height)
    inside &= (column >= 0) & (column < width)
    if view.seen is not None:
        inside[inside] = view.seen[row[inside], column[inside]]
    return inside


def _faces(view: View, points: Float[NDArray, "point 3"]) -> Bool[NDArray, " point"]:
    """Which points of a view's grid frame lie between its left and right edge, at any height."""
    place = pinhole.transform_points(points, view.camera.lidar_to_camera)
    pixels, depth = pinhole.project_points(place, view.camera.projection)
    width = view.camera.image_size[1]
    return (depth > pinhole.MIN_DEPTH) & (pixels[:, 0] > -0.5) & (pixels[:, 0] < width - 0.5)


def _has(view: View, points: Float[NDArray, "point 3"]) -> Bool[NDArray, " point"]:
    """All points of a view's grid frame."""
    return np.ones(len(points), dtype=bool)


def boxes_in_image(
    view: View, boxes: Float[NDArray, "box 4"], image_size: tuple[int, int]
) -> Float[NDArray, "box 4"]:
    """Boxes (xyxy, in pixels of a view) in pixels of an image of ``image_size`` (height, width):
    bounds of where their edges lie."""
    height, width = image_size
    if view.source is None:
        rows, columns = view.camera.image_size
        return (boxes + 0.5) * np.tile([width / columns, height / rows], 2) - 0.5
    if not len(boxes):
        return boxes
    steps = np.linspace(0, 1, 9)
    edges = np.concatenate([np.stack([steps, 0 * steps + end], axis=1) for end in (0, 1)])
    edges = np.concatenate([edges, edges[:, ::-1]])
    points = boxes[:, None, :2] + edges * (boxes[:, None, 2:] - boxes[:, None, :2])
    places = _sample(view.source.astype(np.float32), points)
    shown = np.isfinite(places).all(-1, keepdims=True)  # beyond the lens there is nothing
    lower = np.where(shown, places, np.inf).min(1, initial=np.inf)
    upper = np.where(shown, places, -np.inf).max(1, initial=-np.inf)
    found = np.concatenate([lower, np.maximum(lower, upper)], axis=1).astype(np.float64)
    return found.clip(-0.5, np.tile([width, height], 2) - 0.5)


def boxes_in_grid(view: View, boxes3d: Float[NDArray, "box 6"]) -> Float[NDArray, "box 6"]:
    """3D boxes (centre, size) of a view's camera frame, as their bounds in the vehicle's grid
    frame."""
    own = boxes3d_to_grid(boxes3d.astype(np.float64), view.camera.lidar_to_camera)
    centers = pinhole.transform_points(own[:, :3], view.to_vehicle)
    return np.concatenate([centers, own[:, 3:] @ np.abs(view.to_vehicle[:3, :3]).T], axis=1)
