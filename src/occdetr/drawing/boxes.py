"""Boxes, names, titles and legends on images. All images are RGB."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from occdetr.classes import CLASS_COLORS, CLASS_NAMES, NUM_CLASSES
from occdetr.drawing.wireframe import (
    box_edges,
    clip_segments,
    in_front_of,
    sample_segments,
    to_homogeneous,
)
from occdetr.geometry.camera import Camera
from occdetr.geometry.voxels import VOXEL_SIZE

#: RGB image (height, width, 3).
Image = UInt8[np.ndarray, "_ _ 3"]

BACKGROUND_COLOR = np.array([255, 255, 255], dtype=np.uint8)
INK = (40, 40, 40)
MARGIN = 12  # pixels between images and around text
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_EDGE_SAMPLES = 64  # points on each box edge that are tested for visibility
_HIDDEN_MARGIN = 1.5 * VOXEL_SIZE  # metres that an edge may be inside the voxels that it bounds
_FAINT = 0.5  # opacity of hidden lines


def draw_boxes(
    image: Image,
    boxes_xyxy: Shaped[np.ndarray, "box 4"],
    classes: Int[np.ndarray, " box"] | Sequence[int],
    scores: Float[np.ndarray, " box"] | Sequence[float] | None = None,
) -> Image:
    """A copy of an image with boxes (pixels) in class colours, with class names and scores."""
    boxes = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4)
    classes = np.asarray(classes, dtype=int).reshape(-1)
    names = [CLASS_NAMES[class_id] for class_id in classes]
    if scores is not None:
        order = np.argsort(np.asarray(scores))  # the best score is drawn last, on top
        names = [f"{names[index]} {float(scores[index]):.2f}" for index in order]
        boxes, classes = boxes[order], classes[order]
    return draw_named_boxes(image, boxes, CLASS_COLORS[classes], names)


def draw_named_boxes(
    image: Image,
    boxes_xyxy: Shaped[np.ndarray, "box 4"],
    colors: UInt8[np.ndarray, "box 3"],
    names: Sequence[str],
    thickness: int | None = None,
) -> Image:
    """A copy of an image with boxes (pixels) and name tags, which do not cover each other.

    Later boxes are on top, and their tags are placed first; a tag without a place, and an empty
    one, is left out.
    ``thickness`` is that of the lines in pixels; by default lines and text grow with the image.
    """
    image = np.ascontiguousarray(image).copy()
    side = math.sqrt(image.shape[0] * image.shape[1])
    thick = thickness or max(1, round(side / 450))
    corners = np.rint(boxes_xyxy).astype(int).tolist()
    for (x0, y0, x1, y1), color in zip(corners, colors.tolist(), strict=True):
        cv2.rectangle(image, (x0, y0), (x1, y1), (0, 0, 0), 2 * thick)
        cv2.rectangle(image, (x0, y0), (x1, y1), color, thick)
    taken = np.zeros(image.shape[:2], dtype=bool)
    tags = zip(corners, colors.tolist(), names, strict=True)
    for box, color, name in reversed([tag for tag in tags if tag[-1]]):
        _write_tag(image, name, box, tuple(color), max(0.35, side / 1800), taken)
    return image


def _write_tag(
    image: Image,
    text: str,
    box: Sequence[int],
    color: tuple[int, ...],
    scale: float,
    taken: Bool[np.ndarray, "height width"],
) -> None:
    """Draw text on a filled rectangle above, below or in the box, at the first place that no tag
    has ``taken``; without one, nothing: the color says what it is."""
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    width, height = width + 4, height + 6
    x0, y0, x1, y1 = box
    left, right = x0, x1 - width
    places = [(x, y) for y in (y0 - height, y1, y0, y1 - height) for x in (left, right)]
    most = image.shape[1] - width, image.shape[0] - height
    for place in places:
        x, y = (min(max(value, 0), max(limit, 0)) for value, limit in zip(place, most, strict=True))
        area = taken[y : y + height, x : x + width]
        if not area.any():
            break
    else:
        return
    area[:] = True
    cv2.rectangle(image, (x, y), (x + width - 1, y + height - 1), color, -1)
    luminance = 0.3 * color[0] + 0.59 * color[1] + 0.11 * color[2]
    ink = (0, 0, 0) if luminance > 110 else (255, 255, 255)
    cv2.putText(image, text, (x + 2, y + height - 4), _FONT, scale, ink, 1, cv2.LINE_AA)


def draw_boxes3d(
    image: Image,
    boxes3d: Shaped[np.ndarray, "box 6"],
    colors: UInt8[np.ndarray, "box 3"],
    camera: Camera,
    depth: Float[np.ndarray, "height width"] | None = None,
) -> Image:
    """A copy of the camera's image with the edges of 3D boxes (centre, size; grid frame, metres).

    Where a surface in the ``depth`` image (``render_with_depth``) hides an edge, its line is thin
    and faint.
    """
    edges = box_edges(np.asarray(boxes3d, dtype=np.float64)).reshape(-1, 2, 3)
    kept, edges = clip_segments(edges, camera)
    far_first = np.argsort(-to_homogeneous(edges.mean(axis=1), camera)[:, 2], kind="stable")
    colors = colors[kept[far_first] // 12]
    points = sample_segments(edges[far_first], camera, _EDGE_SAMPLES)
    lines = to_homogeneous(points, camera)
    lines = lines[..., :2] / lines[..., 2:]
    shown = _not_hidden(points, camera, depth)
    faint = _draw_lines(image.copy(), lines, ~shown, colors, 1)
    drawn = cv2.addWeighted(faint, _FAINT, image, 1 - _FAINT, 0)
    thick = max(1, round(image.shape[1] / 640))
    if thick > 1:  # a dark rim makes the lines visible on any image
        drawn = _draw_lines(drawn, lines, shown, np.zeros_like(colors), thick + 2)
    return _draw_lines(drawn, lines, shown, colors, thick)


def _not_hidden(
    points: Float[np.ndarray, "line point 3"], camera: Camera, depth: np.ndarray | None
) -> Bool[np.ndarray, "line point"]:
    """Which points of edges are visible. Points are tested a little above their position, so that
    the ground does not hide lines that lie in it."""
    if depth is None:
        return np.ones(points.shape[:2], dtype=bool)
    above = np.array([0.0, 0.0, _HIDDEN_MARGIN])
    return in_front_of(points + above, depth, camera, _HIDDEN_MARGIN)


def _draw_lines(
    image: Image,
    pixels: Float[np.ndarray, "line point 2"],
    wanted: Bool[np.ndarray, "line point"],
    colors: UInt8[np.ndarray, "line 3"],
    thickness: int,
) -> Image:
    """Draw the wanted parts of lines in place."""
    fixed = np.rint(pixels * 16).astype(np.int32)  # fixed point with 4 fractional bits, see shift
    for line, points, color in zip(wanted, fixed, colors.tolist(), strict=True):
        edges = np.flatnonzero(np.diff(line.astype(int), prepend=0, append=0))
        for start, end in edges.reshape(
            -1, 2
        ).tolist():  # wanted from start up to, but not including, end
            ends = (points[start].tolist(), points[min(end, len(points) - 1)].tolist())
            cv2.line(image, *ends, color, thickness, cv2.LINE_AA, shift=4)
    return image


def class_legend(width: int, classes: Sequence[int] = tuple(range(1, NUM_CLASSES))) -> Image:
    """Rows of colour patches with class names, ``width`` pixels wide."""
    names = [CLASS_NAMES[class_id] for class_id in classes]
    return color_legend(width, names, CLASS_COLORS[list(classes)])


def color_legend(
    width: int, names: Sequence[str], colors: UInt8[np.ndarray, "color 3"], cell: int = 142
) -> Image:
    """Rows of colour patches with their names; the legend is ``width``, each entry ``cell`` pixels
    wide."""
    columns = max(1, (width - 2 * MARGIN) // cell)
    rows = math.ceil(len(names) / columns)
    legend = np.tile(BACKGROUND_COLOR, (rows * 24 + MARGIN, width, 1))
    for number, (name, color) in enumerate(zip(names, colors.tolist(), strict=True)):
        x, y = MARGIN + number % columns * cell, number // columns * 24 + 4
        cv2.rectangle(legend, (x, y), (x + 16, y + 16), color, -1)
        cv2.rectangle(legend, (x, y), (x + 16, y + 16), INK, 1)
        cv2.putText(legend, name, (x + 23, y + 13), _FONT, 0.45, INK, 1, cv2.LINE_AA)
    return legend


def with_title(image: Image, title: str) -> Image:
    """An image below a line of text."""
    bar = np.tile(BACKGROUND_COLOR, (30, image.shape[1], 1))
    cv2.putText(bar, title, (MARGIN, 21), _FONT, 0.6, INK, 1, cv2.LINE_AA)
    return np.concatenate([bar, image])
