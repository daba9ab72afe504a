"""Pictures of grids: the right class at the right place, from every view."""

import numpy as np
import pytest

from occdetr.classes import CLASS_COLORS, CLASS_NAMES, IGNORE
from occdetr.geometry.camera import project_points, transform_points
from occdetr.geometry.voxels import GRID_SHAPE, voxel_centers
from occdetr.visualization import (
    BACKGROUND,
    car_camera,
    class_legend,
    draw_boxes,
    raised_camera,
    render_grid,
    scene_panel,
)

SIZE = (120, 160)


def hue_of(color):
    return np.asarray(color) / np.linalg.norm(np.asarray(color, dtype=float))


@pytest.fixture
def labels():
    grid = np.zeros(GRID_SHAPE, dtype=np.uint8)
    grid[60:80, 165:180, 2:14] = CLASS_NAMES.index("car")  # to the left
    grid[60:80, 80:95, 2:14] = CLASS_NAMES.index("vegetation")  # to the right
    return grid


@pytest.mark.parametrize("view", ["raised", "bird", "camera"])
def test_left_is_left_in_every_view(labels, view):
    image = render_grid(labels, view, SIZE)
    assert image.shape == (*SIZE, 3)
    assert image.dtype == np.uint8
    colored = (image != BACKGROUND).any(axis=2)
    left, right = image[:, :80][colored[:, :80]], image[:, 80:][colored[:, 80:]]
    assert len(left) > 20
    assert len(right) > 20
    for pixels, name in ((left, "car"), (right, "vegetation")):
        hue = hue_of(CLASS_COLORS[CLASS_NAMES.index(name)])
        np.testing.assert_allclose(hue_of(np.median(pixels, axis=0)), hue, atol=0.05)


@pytest.mark.parametrize(("view", "camera"), [("raised", raised_camera), ("camera", car_camera)])
def test_voxels_are_drawn_where_they_project(labels, view, camera):
    projection, lidar_to_camera = camera(SIZE)
    image = render_grid(labels, view, SIZE)
    for name in ("car", "vegetation"):
        voxels = np.argwhere(labels == CLASS_NAMES.index(name))
        points = transform_points(voxel_centers(voxels), lidar_to_camera)
        u, v = np.round(project_points(points, projection)[0]).astype(int).T
        hues = image[v, u] / np.linalg.norm(image[v, u].astype(float), axis=1, keepdims=True)
        right = np.abs(hues - hue_of(CLASS_COLORS[CLASS_NAMES.index(name)])).max(axis=1) < 0.05
        assert right.mean() > 0.99  # half a pixel over the outline is outside


def test_ahead_is_up_from_above():
    grid = np.zeros(GRID_SHAPE, dtype=np.uint8)
    grid[200:, :, 0] = CLASS_NAMES.index("road")
    image = render_grid(grid, "bird", (64, 64))
    assert (image[:10] != BACKGROUND).any()
    assert (image[20:] == BACKGROUND).all()


@pytest.mark.parametrize("view", ["raised", "bird", "camera"])
@pytest.mark.parametrize("value", [0, IGNORE])
def test_empty_and_unknown_are_not_drawn(view, value):
    image = render_grid(np.full(GRID_SHAPE, value, dtype=np.uint8), view, (40, 60))
    assert (image == BACKGROUND).all()


def test_unknown_view_is_refused(labels):
    with pytest.raises((ValueError, TypeError), match="raised"):
        render_grid(labels, "side")  # pyright: ignore[reportArgumentType]


def test_boxes_are_drawn_on_a_copy():
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    boxes = np.array([[20.2, 30.0, 60.0, 80.0], [-30.0, -10.0, 400.0, 500.0]])
    drawn = draw_boxes(image, boxes, [1, 19], [0.9, 0.4])
    assert not image.any()
    assert (drawn[80, 40] == CLASS_COLORS[1]).all()
    none = draw_boxes(image, np.zeros((0, 4)), [])
    assert (none == image).all()


def test_panel_holds_image_grids_and_legend(labels):
    image = np.full((37, 122, 3), 90, dtype=np.uint8)
    boxes = np.array([[10.0, 5.0, 40.0, 30.0]])
    both = scene_panel(image, boxes, [1], [0.5], labels, labels, width=640, title="frame 08/000005")
    one = scene_panel(image, boxes, [1], prediction=labels, width=640)
    bare = scene_panel(image, width=640)
    assert both.shape[1] == one.shape[1] == bare.shape[1] == 640
    assert both.shape[0] > bare.shape[0]
    legend = class_legend(640)
    for color in CLASS_COLORS[1:]:
        assert (legend == color).all(axis=2).any()
        assert (both == color).all(axis=2).any()
