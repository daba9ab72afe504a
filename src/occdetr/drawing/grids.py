"""Images of voxel grids by ray casting, without a display server.

Several rays are cast through each pixel. Voxels have the paper's class colours or those of another
palette; the brightness of a face depends on its direction. Empty (0) and unknown (255) voxels are
not drawn. All images are RGB.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8

from occdetr.classes import CLASS_COLORS, IGNORE
from occdetr.drawing.boxes import BACKGROUND_COLOR, Image
from occdetr.geometry.camera import Camera, resize_camera
from occdetr.geometry.raycast import camera_rays, cast_rays
from occdetr.geometry.voxels import GRID_SHAPE, VOXEL_SIZE, metres_to_voxels, voxels_to_metres

View = Literal["raised", "bird", "camera"]

# Brightness of the faces in the order of raycast.FACE_NORMALS: -x, +x, -y, +y, -z, +z.
FACE_LIGHT = np.array([0.80, 0.62, 0.72, 0.66, 0.50, 1.0], dtype=np.float32)
SAMPLES = 2  # rays through each pixel, along each axis
_RAYS_AT_ONCE = 1 << 18  # limits the memory for an image
#: First palette index of the objects in a painted grid, after the classes and IGNORE.
FIRST_OBJECT = IGNORE + 1
#: Colour of voxels of object classes that belong to no object.
UNCLAIMED = np.array([128, 128, 128], dtype=np.uint8)
_PALE = 0.25  # share of a background class's colour in a painted grid; the rest is white


def render_grid(
    labels: Integer[np.ndarray, "x y z"],
    view: View = "raised",
    size: tuple[int, int] = (480, 640),
    palette: UInt8[np.ndarray, "color 3"] = CLASS_COLORS,
    samples: int = SAMPLES,
) -> Image:
    """Draw a grid of indices into ``palette``: classes 0-19, or the result of ``paint_objects``.

    ``size`` is (height, width) in pixels. The view ``raised`` looks ahead from above and behind the
    car, ``bird`` straight down with ahead upwards, ``camera`` through a camera like KITTI's. For
    other cameras see ``render_with_depth``. Each pixel is the mean of ``samples`` x ``samples``
    rays.
    """
    if view not in ("raised", "bird", "camera"):
        raise ValueError(f"view {view!r}: use raised, bird or camera")
    if view == "bird":
        return _render_bird(labels, size, palette, samples)
    camera = raised_camera(size) if view == "raised" else car_camera(size)
    return render_with_depth(labels, camera, palette, samples)[0]


def raised_camera(size: tuple[int, int]) -> Camera:
    """A camera above and behind the car that sees the whole grid."""
    eye, target = np.array([-17.0, 0.0, 19.0]), np.array([20.0, 0.0, -3.5])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    lidar_to_camera = np.eye(4)
    lidar_to_camera[:3, :3], lidar_to_camera[:3, 3] = rotation, -rotation @ eye
    height, width = size
    return Camera(_pinhole(0.98 * min(width, 1.33 * height), size), lidar_to_camera, size)


def car_camera(size: tuple[int, int]) -> Camera:
    """A camera with KITTI's position and horizontal field of view."""
    lidar_to_camera = np.eye(4)
    lidar_to_camera[:3] = [[0, -1, 0, 0], [0, 0, -1, -0.07], [1, 0, 0, -0.33]]
    return Camera(_pinhole(0.577 * size[1], size), lidar_to_camera, size)


def bird_camera(size: tuple[int, int]) -> Camera:
    """The affine camera of the bird's eye view, for drawing lines over it; every depth is 1."""
    height, width = size
    side = min(size)
    scale = side / (GRID_SHAPE[0] * VOXEL_SIZE)
    far_left = voxels_to_metres(np.array([GRID_SHAPE[0], GRID_SHAPE[1], 0]))
    column, row = (width - side) // 2 - 0.5, (height - side) // 2 - 0.5
    projection = np.array(
        [
            [0, -scale, 0, column + scale * far_left[1]],
            [-scale, 0, 0, row + scale * far_left[0]],
            [0, 0, 0, 1],
        ]
    )
    return Camera(projection, np.eye(4), size)


def _pinhole(focal: float, size: tuple[int, int]) -> Float[np.ndarray, "3 4"]:
    u, v = (size[1] - 1) / 2, (size[0] - 1) / 2
    return np.array([[focal, 0, u, 0], [0, focal, v, 0], [0, 0, 1, 0]], dtype=np.float64)


def render_with_depth(
    labels: Integer[np.ndarray, "x y z"],
    camera: Camera,
    palette: UInt8[np.ndarray, "color 3"] = CLASS_COLORS,
    samples: int = SAMPLES,
) -> tuple[Image, Float[np.ndarray, "height width"]]:
    """As ``render_grid``, through ``camera``, with a depth image.

    The depth of a pixel is that of its farthest ray, in metres along the camera's axis, infinite
    if a ray hits nothing.
    """
    size = camera.image_size
    fine_size = (size[0] * samples, size[1] * samples)
    fine = resize_camera(camera, fine_size)
    origins, directions = camera_rays(fine)
    origins = metres_to_voxels(origins)
    pixel_angle = 1 / camera.projection[0, 0]
    image = np.tile(BACKGROUND_COLOR, (len(directions), 1))
    depth = np.full(len(directions), np.inf)
    drawn = _drawn(labels)
    for start in range(0, len(directions), _RAYS_AT_ONCE):
        rays = slice(start, start + _RAYS_AT_ONCE)
        hits, distances, faces = cast_rays(drawn, origins[rays], directions[rays])
        seen = np.flatnonzero(hits[:, 0] >= 0)
        voxels, distances, faces = hits[seen], distances[seen, None], faces[seen]
        inside = origins[rays][seen] + distances * directions[rays][seen] - voxels
        light = _light(inside, faces, distances[:, 0] * pixel_angle)
        colors = palette[labels[tuple(voxels.T)]] * light[:, None]
        image[rays][seen] = np.clip(colors, 0, 255).astype(np.uint8)
        depth[rays][seen] = distances[:, 0] * VOXEL_SIZE
    axis = (np.asarray(fine.projection) @ np.asarray(fine.lidar_to_camera))[2, :3]
    depth *= directions @ axis  # from along the ray to along the camera's axis
    blocks = depth.reshape(size[0], samples, size[1], samples)
    return _shrink(image.reshape(*fine_size, 3), size), blocks.max(axis=(1, 3))


def _drawn(labels: Integer[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    return (labels > 0) & (labels != IGNORE)


def _shrink(image: Image, size: tuple[int, int]) -> Image:
    """Reduce an image to ``size``; each pixel is the mean of a block."""
    if image.shape[:2] == size:
        return image
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)


def _light(
    inside: Float[np.ndarray, "hit 3"],
    faces: Integer[np.ndarray, " hit"],
    pixel: Float[np.ndarray, " hit"],
) -> Float[np.ndarray, " hit"]:
    """Brightness by the direction of the face, reduced near its edges, which gives lines about one
    pixel wide that fade where a voxel covers only a few pixels.

    ``inside``: positions in the voxel, 0-1. ``pixel``: the size of a pixel there, in voxels.
    """
    distance = np.minimum(inside, 1 - inside)
    axis = np.maximum(faces, 0) // 2
    distance[np.arange(len(axis)), axis] = 1.0  # there is no edge along the face's normal
    nearest = distance.min(axis=1)
    strength = np.clip(0.32 - 1.1 * pixel, 0.0, 0.28)
    edge = 1 - strength * (nearest < np.maximum(0.6 * pixel, 0.02))
    return np.where(faces >= 0, FACE_LIGHT[faces], np.float32(1.0)) * edge


def _render_bird(
    labels: np.ndarray, size: tuple[int, int], palette: np.ndarray, samples: int
) -> Image:
    """The highest voxel of each column; brightness increases with its height."""
    drawn = _drawn(labels)
    top = labels.shape[2] - 1 - np.argmax(drawn[:, :, ::-1], axis=2)
    indices = np.take_along_axis(labels, top[:, :, None], axis=2)[:, :, 0]
    light = 0.72 + 0.28 * np.clip(top / (0.6 * labels.shape[2]), 0, 1)
    seen = drawn.any(axis=2)
    colors = np.tile(BACKGROUND_COLOR, (*seen.shape, 1))
    colors[seen] = (palette[indices[seen]] * light[seen, None]).astype(np.uint8)
    upright = np.ascontiguousarray(colors[::-1, ::-1])  # ahead is up, left is left
    side = min(size)
    shrink = side < max(upright.shape[:2])
    fine = side if shrink else side * samples
    interpolation = cv2.INTER_AREA if shrink else cv2.INTER_NEAREST
    square = cv2.resize(upright, (fine, fine), interpolation=interpolation)
    image = np.tile(BACKGROUND_COLOR, (*size, 1))
    row, column = (size[0] - side) // 2, (size[1] - side) // 2
    image[row : row + side, column : column + side] = _shrink(square, (side, side))
    return image


def paint_objects(
    labels: UInt8[np.ndarray, "x y z"],
    voxels: Integer[np.ndarray, "voxel 3"],
    voxel_object: Integer[np.ndarray, " voxel"],
    object_classes: Sequence[int],
) -> tuple[Integer[np.ndarray, "x y z"], UInt8[np.ndarray, "color 3"]]:
    """A grid and its palette for ``render_grid``, with one colour for each object.

    ``voxels`` (indices) belong to the objects ``voxel_object``. Background classes are pale, and
    voxels of ``object_classes`` that belong to no object are grey.
    """
    painted = labels.astype(np.int32)
    painted[tuple(voxels.T)] = FIRST_OBJECT + voxel_object
    number = int(voxel_object.max()) + 1 if len(voxel_object) else 0
    palette = np.zeros((FIRST_OBJECT + number, 3), dtype=np.uint8)
    palette[: len(CLASS_COLORS)] = _PALE * CLASS_COLORS + (1 - _PALE) * BACKGROUND_COLOR
    palette[list(object_classes)] = UNCLAIMED
    palette[FIRST_OBJECT:] = object_colors(number)
    return painted, palette


@functools.cache
def object_colors(number: int) -> UInt8[np.ndarray, "color 3"]:
    """``number`` saturated colours that differ from each other and from white.

    Each is the candidate with the largest distance (CIELAB) to all before it, so the first ones
    differ most. They repeat after some hundred.
    """
    levels = np.linspace(0, 1, 12, dtype=np.float32)
    rgb = np.array(list(itertools.product(levels, repeat=3)), dtype=np.float32)
    lab = cv2.cvtColor(rgb[None], cv2.COLOR_RGB2Lab)[0]
    strong = (np.hypot(lab[:, 1], lab[:, 2]) > 45) & (lab[:, 0] > 35) & (lab[:, 0] < 82)
    rgb, lab = rgb[strong], lab[strong]
    gap = np.linalg.norm(lab - [100.0, 0.0, 0.0], axis=1)
    chosen = []
    for _ in range(min(number, len(rgb))):
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(lab - lab[chosen[-1]], axis=1))
    colors = np.rint(255 * rgb[np.resize(chosen, number).astype(int)]).astype(np.uint8)
    colors.setflags(write=False)  # all callers share the cached array
    return colors
