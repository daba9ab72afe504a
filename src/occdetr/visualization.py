"""Pictures of voxel grids, boxes and whole frames, without a display server.

A grid is drawn by casting one ray per pixel, in the paper's class colours, lit by the direction
of each face; empty (0) and unknown (255) voxels are not drawn. All pictures are RGB.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from occdetr.classes import CLASS_COLORS, CLASS_NAMES, IGNORE
from occdetr.geometry.raycast import camera_rays, cast_rays, metres_to_voxels

View = Literal["raised", "bird", "camera"]
#: RGB picture (height, width, 3).
Image = UInt8[np.ndarray, "_ _ 3"]

#: Projection (3, 4) and lidar_to_camera (4, 4) of a camera.
Camera = tuple[np.ndarray, np.ndarray]

BACKGROUND = np.array([255, 255, 255], dtype=np.uint8)
INK = (40, 40, 40)
# Brightness of the faces in the order of FACE_NORMALS: behind, ahead, right, left, below, above.
FACE_LIGHT = np.array([0.80, 0.62, 0.72, 0.66, 0.50, 1.0], dtype=np.float32)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MARGIN = 12


def render_grid(
    labels: UInt8[np.ndarray, "x y z"],
    view: View = "raised",
    size: tuple[int, int] = (480, 640),
    camera: Camera | None = None,
) -> Image:
    """Draw a grid of classes 0-19 and 255; ``size`` is (height, width) in pixels.

    ``raised`` looks ahead from above and behind the car, ``bird`` straight down with ahead
    upwards, ``camera`` through ``camera``, whose projection is that of an image of ``size``
    (default: a camera like KITTI's). For ``raised`` a camera may be given too.
    """
    if view not in ("raised", "bird", "camera"):
        raise ValueError(f"view {view!r}: use raised, bird or camera")
    drawn = (labels > 0) & (labels != IGNORE)
    if view == "bird":
        return _render_bird(labels, drawn, size)
    default = raised_camera(size) if view == "raised" else car_camera(size)
    return _render_rays(labels, drawn, size, camera or default)


def raised_camera(size: tuple[int, int]) -> Camera:
    """A camera behind and above the car that sees the whole grid."""
    eye, target = np.array([-17.0, 0.0, 19.0]), np.array([20.0, 0.0, -3.5])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    lidar_to_camera = np.eye(4)
    lidar_to_camera[:3, :3], lidar_to_camera[:3, 3] = rotation, -rotation @ eye
    height, width = size
    return _pinhole(0.98 * min(width, 1.33 * height), size), lidar_to_camera


def car_camera(size: tuple[int, int]) -> Camera:
    """A camera with KITTI's place and horizontal field of view."""
    lidar_to_camera = np.eye(4)
    lidar_to_camera[:3] = [[0, -1, 0, 0], [0, 0, -1, -0.07], [1, 0, 0, -0.33]]
    return _pinhole(0.577 * size[1], size), lidar_to_camera


def _pinhole(focal: float, size: tuple[int, int]) -> Float[np.ndarray, "3 4"]:
    u, v = (size[1] - 1) / 2, (size[0] - 1) / 2
    return np.array([[focal, 0, u, 0], [0, focal, v, 0], [0, 0, 1, 0]], dtype=np.float64)


def _render_rays(labels: np.ndarray, drawn: np.ndarray, size: tuple[int, int], camera: Camera):
    origins, directions = camera_rays(*camera, size)
    origins = metres_to_voxels(origins)
    hits, distances, faces = cast_rays(drawn, origins, directions)
    seen = np.flatnonzero(hits[:, 0] >= 0)
    voxels = hits[seen]
    light = np.where(faces[seen] >= 0, FACE_LIGHT[faces[seen]], np.float32(1.0))
    points = origins[seen] + distances[seen, None] * directions[seen]
    pixel = distances[seen] / camera[0][0, 0]  # the size of a pixel, in voxels
    light *= _edge_light(points - voxels, faces[seen], pixel)
    image = np.tile(BACKGROUND, (len(directions), 1))
    colors = CLASS_COLORS[labels[tuple(voxels.T)]]
    image[seen] = np.clip(colors * light[:, None], 0, 255).astype(np.uint8)
    return image.reshape(*size, 3)


def _edge_light(
    inside: Float[np.ndarray, "hit 3"], faces: Int[np.ndarray, " hit"], pixel: np.ndarray
) -> Float[np.ndarray, " hit"]:
    """Darker near the edges of a voxel's face, for lines about a pixel wide; the lines fade where
    voxels get as small as a few pixels. ``inside`` are positions in the voxel, 0-1."""
    distance = np.minimum(inside, 1 - inside)
    axis = np.maximum(faces, 0) // 2
    distance[np.arange(len(axis)), axis] = 1.0  # the face's own axis has no edge
    nearest = distance.min(axis=1)
    strength = np.clip(0.32 - 1.1 * pixel, 0.0, 0.28)
    return 1 - strength * (nearest < np.maximum(0.6 * pixel, 0.02))


def _render_bird(labels: np.ndarray, drawn: np.ndarray, size: tuple[int, int]) -> Image:
    """The highest voxel of each column, brighter the higher it is."""
    top = labels.shape[2] - 1 - np.argmax(drawn[:, :, ::-1], axis=2)
    classes = np.take_along_axis(labels, top[:, :, None], axis=2)[:, :, 0]
    light = 0.72 + 0.28 * np.clip(top / (0.6 * labels.shape[2]), 0, 1)
    classes = np.where(drawn.any(axis=2), classes, 0)
    colors = (CLASS_COLORS[classes] * light[..., None]).astype(np.uint8)
    colors[classes == 0] = BACKGROUND
    upright = np.ascontiguousarray(colors[::-1, ::-1])  # ahead is up, left is left
    side = min(size)
    shrink = side < max(upright.shape[:2])
    interpolation = cv2.INTER_AREA if shrink else cv2.INTER_NEAREST
    square = cv2.resize(upright, (side, side), interpolation=interpolation)
    image = np.tile(BACKGROUND, (*size, 1))
    row, column = (size[0] - side) // 2, (size[1] - side) // 2
    image[row : row + side, column : column + side] = square
    return image


def draw_boxes(
    image: Image,
    boxes_xyxy: Shaped[np.ndarray, "box 4"],
    classes: Int[np.ndarray, " box"] | Sequence[int],
    scores: Float[np.ndarray, " box"] | Sequence[float] | None = None,
) -> Image:
    """A copy of a picture with boxes (pixels) in class colours, named, with their scores."""
    image = np.ascontiguousarray(image).copy()
    boxes = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4)
    classes = np.asarray(classes, dtype=int).reshape(-1)
    order = np.arange(len(boxes)) if scores is None else np.argsort(np.asarray(scores))
    thick = max(1, round(image.shape[0] / 250))
    for index in order.tolist():  # the best score is drawn last
        x0, y0, x1, y1 = (round(float(value)) for value in boxes[index])
        color = tuple(int(value) for value in CLASS_COLORS[classes[index]])
        cv2.rectangle(image, (x0, y0), (x1, y1), (0, 0, 0), thick + 2)
        cv2.rectangle(image, (x0, y0), (x1, y1), color, thick)
        text = CLASS_NAMES[classes[index]]
        if scores is not None:
            text += f" {float(scores[index]):.2f}"
        _write_tag(image, text, (x0, y0), color)
    return image


def _write_tag(image: Image, text: str, corner: tuple[int, int], color: tuple[int, ...]) -> None:
    """Text on a plate of the class colour, above the corner or, at the top edge, under it."""
    scale = max(0.3, image.shape[0] / 1000)
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    x = min(max(corner[0], 0), max(image.shape[1] - width - 4, 0))
    y = corner[1] - 3 if corner[1] - height - 6 >= 0 else corner[1] + height + 5
    cv2.rectangle(image, (x, y - height - 3), (x + width + 4, y + 3), color, -1)
    luminance = 0.3 * color[0] + 0.59 * color[1] + 0.11 * color[2]
    ink = (0, 0, 0) if luminance > 110 else (255, 255, 255)
    cv2.putText(image, text, (x + 2, y), _FONT, scale, ink, 1, cv2.LINE_AA)


def class_legend(width: int, classes: Sequence[int] = tuple(range(1, 20))) -> Image:
    """Rows of colour patches with class names, ``width`` pixels wide."""
    cell = 142
    columns = max(1, (width - 2 * _MARGIN) // cell)
    rows = math.ceil(len(classes) / columns)
    legend = np.tile(BACKGROUND, (rows * 24 + _MARGIN, width, 1))
    for number, class_id in enumerate(classes):
        x, y = _MARGIN + number % columns * cell, number // columns * 24 + 4
        color = tuple(int(value) for value in CLASS_COLORS[class_id])
        cv2.rectangle(legend, (x, y), (x + 16, y + 16), color, -1)
        cv2.rectangle(legend, (x, y), (x + 16, y + 16), INK, 1)
        cv2.putText(
            legend, CLASS_NAMES[class_id], (x + 23, y + 13), _FONT, 0.45, INK, 1, cv2.LINE_AA
        )
    return legend


def scene_panel(
    image: Image,
    boxes_xyxy: Shaped[np.ndarray, "box 4"] | None = None,
    classes: Int[np.ndarray, " box"] | Sequence[int] = (),
    scores: Float[np.ndarray, " box"] | Sequence[float] | None = None,
    truth: UInt8[np.ndarray, "x y z"] | None = None,
    prediction: UInt8[np.ndarray, "x y z"] | None = None,
    width: int = 1280,
    title: str = "",
) -> Image:
    """One picture of a frame: the image with its boxes (pixels of ``image``) on top, below it the
    grids that are given, seen from behind and above, and a legend of the class colours."""
    height = round(image.shape[0] * width / image.shape[1])
    shrink = image.shape[1] > width
    resized = cv2.resize(
        image, (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR
    )
    if boxes_xyxy is not None:
        scale = width / image.shape[1]
        boxes = (np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4) + 0.5) * scale - 0.5
        resized = draw_boxes(resized, boxes, classes, scores)
    rows = [_with_title(resized, title)] if title else [resized]
    grids = [("ground truth", truth), ("prediction", prediction)]
    grids = [(name, grid) for name, grid in grids if grid is not None]
    if grids:
        each = (width - _MARGIN * (len(grids) - 1)) // len(grids)
        size = (round(each * (0.7 if len(grids) > 1 else 0.5)), each)
        views = [_with_title(render_grid(grid, "raised", size), name) for name, grid in grids]
        row = np.tile(BACKGROUND, (views[0].shape[0], width, 1))
        for number, picture in enumerate(views):
            start = number * (each + _MARGIN)
            row[:, start : start + each] = picture
        rows += [row, class_legend(width)]
    return np.concatenate(rows)


def _with_title(image: Image, title: str) -> Image:
    bar = np.tile(BACKGROUND, (30, image.shape[1], 1))
    cv2.putText(bar, title, (_MARGIN, 21), _FONT, 0.6, INK, 1, cv2.LINE_AA)
    return np.concatenate([bar, image])
