"""Panels: several images of one frame in one. All images are RGB."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, Int16, Int32, Int64, Shaped, UInt8

from occdetr.classes import CLASS_COLORS, CLASS_NAMES
from occdetr.drawing.boxes import (
    BACKGROUND_COLOR,
    MARGIN,
    Image,
    class_legend,
    color_legend,
    draw_boxes,
    draw_boxes3d,
    draw_named_boxes,
    with_title,
)
from occdetr.drawing.grids import (
    UNCLAIMED,
    bird_camera,
    object_colors,
    paint_objects,
    raised_camera,
    render_grid,
    render_with_depth,
)
from occdetr.geometry.camera import Camera, denormalize_pixels, resize_camera

GAP = 4  # pixels between the images of a contact sheet
COLUMN = 634  # pixels, the width of a frame's truth or prediction in a comparison


@runtime_checkable
class ObjectArrays(Protocol):
    """The objects of a frame, see ``occdetr.data.objects.SceneObjects``."""

    classes: Int64[np.ndarray, " object"]
    boxes_cxcywh: Float32[np.ndarray, "object 4"]
    boxes3d_grid: Float32[np.ndarray, "object 6"]
    voxels: Int16[np.ndarray, "voxel 3"]
    voxel_object: Int32[np.ndarray, " voxel"]
    visible_fraction: Float32[np.ndarray, " object"]


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
    """The image of a frame with 2D boxes (pixels of ``image``), below it the given grids in the
    raised view and a legend of the class colours. The panel is ``width`` pixels wide."""
    height = round(image.shape[0] * width / image.shape[1])
    shrink = image.shape[1] > width
    resized = cv2.resize(
        image, (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR
    )
    if boxes_xyxy is not None:
        scale = width / image.shape[1]
        boxes = (np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4) + 0.5) * scale - 0.5
        resized = draw_boxes(resized, boxes, classes, scores)
    rows = [with_title(resized, title)] if title else [resized]
    grids = [("ground truth", truth), ("prediction", prediction)]
    grids = [(name, grid) for name, grid in grids if grid is not None]
    if grids:
        each = (width - MARGIN * (len(grids) - 1)) // len(grids)
        size = (round(each * (0.7 if len(grids) > 1 else 0.5)), each)
        views = [with_title(render_grid(grid, "raised", size), name) for name, grid in grids]
        row = np.tile(BACKGROUND_COLOR, (views[0].shape[0], width, 1))
        for number, picture in enumerate(views):
            start = number * (each + MARGIN)
            row[:, start : start + each] = picture
        rows += [row, class_legend(width)]
    return np.concatenate(rows)


def video_panel(
    image: Image,
    boxes_xyxy: Shaped[np.ndarray, "box 4"],
    classes: Int[np.ndarray, " box"] | Sequence[int],
    scores: Float[np.ndarray, " box"] | Sequence[float] | None,
    grid: UInt8[np.ndarray, "x y z"],
    size: tuple[int, int] = (480, 1280),
) -> Image:
    """A picture of a video, of ``size`` (height, width) whatever that of ``image``: the image with
    2D boxes (its pixels) and the legend below it, and the grid in the raised view beside it."""
    height, width = size
    wide = round(0.6 * width)
    legend = class_legend(wide)
    free = height - len(legend)
    scale = min(wide / image.shape[1], free / image.shape[0])
    rows, columns = max(round(image.shape[0] * scale), 1), max(round(image.shape[1] * scale), 1)
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    shown = cv2.resize(image, (columns, rows), interpolation=method)
    boxes = (np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4) + 0.5) * scale - 0.5
    panel = np.tile(BACKGROUND_COLOR, (height, width, 1))
    top, left = (free - rows) // 2, (wide - columns) // 2
    panel[top : top + rows, left : left + columns] = draw_boxes(shown, boxes, classes, scores)
    panel[free:, :wide] = legend
    panel[:, wide:] = render_grid(grid, "raised", (height, width - wide))
    return panel


def scene_column(
    image: Image,
    boxes_xyxy: Shaped[np.ndarray, "box 4"],
    classes: Int[np.ndarray, " box"] | Sequence[int],
    scores: Float[np.ndarray, " box"] | Sequence[float] | None,
    grid: UInt8[np.ndarray, "x y z"],
    title: str,
) -> Image:
    """A frame's truth, or its prediction: the image with 2D boxes (pixels of ``image``), below it
    the grid in the raised view and from above. The column is ``COLUMN`` pixels wide."""
    scale = COLUMN / image.shape[1]
    size = (COLUMN, round(image.shape[0] * scale))
    shown = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    boxes = (np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4) + 0.5) * scale - 0.5
    side = round(0.41 * COLUMN)
    raised = render_grid(grid, "raised", (side, COLUMN - side - GAP))
    gap = np.tile(BACKGROUND_COLOR, (side, GAP, 1))
    views = np.hstack([raised, gap, render_grid(grid, "bird", (side, side))])
    return with_title(np.vstack([draw_boxes(shown, boxes, classes, scores), views]), title)


def comparison_panel(columns: Sequence[Image], title: str) -> Image:
    """Columns of equal height side by side, above the legend of the classes."""
    gap = np.tile(BACKGROUND_COLOR, (len(columns[0]), MARGIN, 1))
    row = np.hstack([part for column in columns for part in (column, gap)][:-1])
    return with_title(np.vstack([row, class_legend(row.shape[1])]), title)


def label_panel(
    image: Image | None,
    camera: Camera,
    labels: UInt8[np.ndarray, "x y z"],
    objects: ObjectArrays,
    object_classes: Sequence[int],
    title: str = "",
) -> Image:
    """The object labels of a frame, each object in the same colour throughout.

    The panel is as wide as the camera's image. It shows the image with 2D boxes (thin) and
    projected 3D boxes, the grid through the same camera, the grid in the raised view and from
    above, and a list of the objects. Without an ``image`` the boxes are drawn on the grid through
    the camera.
    """
    width = camera.image_size[1]
    painted, palette = paint_objects(labels, objects.voxels, objects.voxel_object, object_classes)
    grid, depth = render_with_depth(painted, camera, palette)
    rows = [_with_boxes(grid if image is None else image, objects, camera, depth)]
    if image is not None:
        rows.append(grid)
    rows += [_grid_views(painted, palette, objects.boxes3d_grid, width), _legend(objects, width)]
    return with_title(np.concatenate(rows), title)


def _with_boxes(
    image: Image, objects: ObjectArrays, camera: Camera, depth: Float[np.ndarray, "height width"]
) -> Image:
    colors = object_colors(len(objects.classes))
    centers, half = objects.boxes_cxcywh[:, :2], objects.boxes_cxcywh[:, 2:] / 2
    corners = [
        denormalize_pixels(corner, camera.image_size) for corner in (centers - half, centers + half)
    ]
    image = draw_boxes3d(image, objects.boxes3d_grid, colors, camera, depth)
    numbers = [str(number) for number in range(1, len(objects.classes) + 1)]
    return draw_named_boxes(image, np.concatenate(corners, axis=1), colors, numbers, thickness=1)


def _grid_views(
    painted: np.ndarray, palette: np.ndarray, boxes3d: Float[np.ndarray, "object 6"], width: int
) -> Image:
    """The grid with its boxes, in the raised view and from above, side by side."""
    side = round(0.42 * width)
    lines = object_colors(len(boxes3d)) // 2  # darker than the voxels under them
    camera = raised_camera((side, width - side - MARGIN))
    raised, depth = render_with_depth(painted, camera, palette)
    raised = draw_boxes3d(raised, boxes3d, lines, camera, depth)
    bird = render_grid(painted, "bird", (side, side), palette)
    bird = draw_boxes3d(bird, boxes3d, lines, bird_camera((side, side)))
    return np.concatenate([raised, np.tile(BACKGROUND_COLOR, (side, MARGIN, 1)), bird], axis=1)


def _legend(objects: ObjectArrays, width: int) -> Image:
    names = [
        f"{number} {CLASS_NAMES[class_id]} {visible:.0%}"
        for number, (class_id, visible) in enumerate(
            zip(objects.classes, objects.visible_fraction, strict=True), start=1
        )
    ]
    colors = np.concatenate([object_colors(len(objects.classes)), UNCLAIMED[None]])
    return color_legend(width, [*names, "of no object"], colors, cell=178)


def sheet_row(
    image: Image, camera: Camera, labels: UInt8[np.ndarray, "x y z"], width: int
) -> Image:
    """A row of a contact sheet: the image, the labels through its camera and in the raised view."""
    wide = int(0.38 * width)
    size = (round(wide * camera.image_size[0] / camera.image_size[1]), wide)
    small = cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA)
    through = render_with_depth(labels, resize_camera(camera, size))[0]
    raised = render_grid(labels, "raised", (size[0], width - 2 * wide - 2 * GAP))
    gap = np.tile(BACKGROUND_COLOR, (size[0], GAP, 1))
    return np.hstack([small, gap, through, gap, raised])


def prediction_row(
    image: Image,
    boxes_xyxy: Shaped[np.ndarray, "box 4"],
    classes: Int[np.ndarray, " box"] | Sequence[int],
    truth: UInt8[np.ndarray, "x y z"],
    prediction: UInt8[np.ndarray, "x y z"],
    width: int,
) -> Image:
    """A row of a contact sheet: the image with 2D boxes, the true and the predicted grid in the
    raised view."""
    wide, each = _columns(width)
    scale = wide / image.shape[1]
    height = round(image.shape[0] * scale)
    shown = cv2.resize(image, (wide, height), interpolation=cv2.INTER_LINEAR)
    boxes = (np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4) + 0.5) * scale - 0.5
    gap = np.tile(BACKGROUND_COLOR, (height, GAP, 1))
    colors = CLASS_COLORS[np.asarray(classes, dtype=int)]
    parts = [draw_named_boxes(shown, boxes, colors, [""] * len(boxes))]  # the legend names them
    for grid in (truth, prediction):
        parts += [gap, render_grid(grid, "raised", (height, each))]
    return np.hstack(parts)


def prediction_titles(width: int) -> Image:
    """What the columns of ``prediction_row`` are, as the first row of a contact sheet."""
    wide, each = _columns(width)
    names = (("image", wide), ("ground truth", each), ("prediction", each))
    empty = [np.tile(BACKGROUND_COLOR, (0, columns, 1)) for _, columns in names]
    parts = [with_title(part, name) for part, (name, _) in zip(empty, names, strict=True)]
    gap = np.tile(BACKGROUND_COLOR, (len(parts[0]), GAP, 1))
    return np.hstack([parts[0], gap, parts[1], gap, parts[2]])


def _columns(width: int) -> tuple[int, int]:
    """Pixels of the image, and of each grid, in a row of predictions."""
    wide = int(0.4 * width)
    return wide, (width - wide - 2 * GAP) // 2


def contact_sheet(rows: Sequence[Image]) -> Image:
    """Rows below each other, above the legend of the classes."""
    gap = np.tile(BACKGROUND_COLOR, (GAP, rows[0].shape[1], 1))
    legend = class_legend(rows[0].shape[1])
    return np.vstack([part for row in rows for part in (row, gap)] + [legend])
