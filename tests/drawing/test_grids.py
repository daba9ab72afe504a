"""Images of grids: the right class at the right place in every view."""

import cv2
import numpy as np
import pytest

from occdetr.classes import CLASS_COLORS, CLASS_NAMES, IGNORE
from occdetr.drawing.boxes import BACKGROUND_COLOR
from occdetr.drawing.grids import (
    UNCLAIMED,
    car_camera,
    object_colors,
    paint_objects,
    raised_camera,
    render_grid,
    render_with_depth,
)
from occdetr.geometry.camera import project_points, transform_points
from occdetr.geometry.voxels import GRID_SHAPE, voxel_centers
from voxel_scenes import SIZE, car_and_vegetation


def hue_of(color):
    return np.asarray(color) / np.linalg.norm(np.asarray(color, dtype=float))


@pytest.fixture
def labels():
    return car_and_vegetation()


@pytest.mark.parametrize("view", ["raised", "bird", "camera"])
def test_left_is_left_in_every_view(labels, view):
    image = render_grid(labels, view, SIZE)
    assert image.shape == (*SIZE, 3)
    assert image.dtype == np.uint8
    colored = (image != BACKGROUND_COLOR).any(axis=2)
    left, right = image[:, :80][colored[:, :80]], image[:, 80:][colored[:, 80:]]
    assert len(left) > 20
    assert len(right) > 20
    for pixels, name in ((left, "car"), (right, "vegetation")):
        hue = hue_of(CLASS_COLORS[CLASS_NAMES.index(name)])
        np.testing.assert_allclose(hue_of(np.median(pixels, axis=0)), hue, atol=0.05)


@pytest.mark.parametrize(("view", "camera"), [("raised", raised_camera), ("camera", car_camera)])
def test_voxels_are_drawn_where_they_project(labels, view, camera):
    seen = camera(SIZE)
    image = render_grid(labels, view, SIZE)
    for name in ("car", "vegetation"):
        voxels = np.argwhere(labels == CLASS_NAMES.index(name))
        points = transform_points(voxel_centers(voxels), seen.lidar_to_camera)
        u, v = np.round(project_points(points, seen.projection)[0]).astype(int).T
        hues = image[v, u] / np.linalg.norm(image[v, u].astype(float), axis=1, keepdims=True)
        right = np.abs(hues - hue_of(CLASS_COLORS[CLASS_NAMES.index(name)])).max(axis=1) < 0.05
        assert right.mean() > 0.99  # points on the outline may be half a pixel outside


def test_ahead_is_up_in_the_birds_eye_view():
    grid = np.zeros(GRID_SHAPE, dtype=np.uint8)
    grid[200:, :, 0] = CLASS_NAMES.index("road")
    image = render_grid(grid, "bird", (64, 64))
    assert (image[:10] != BACKGROUND_COLOR).any()
    assert (image[20:] == BACKGROUND_COLOR).all()


@pytest.mark.parametrize("view", ["raised", "bird", "camera"])
@pytest.mark.parametrize("value", [0, IGNORE])
def test_empty_and_unknown_are_not_drawn(view, value):
    image = render_grid(np.full(GRID_SHAPE, value, dtype=np.uint8), view, (40, 60))
    assert (image == BACKGROUND_COLOR).all()


def test_unknown_views_are_rejected(labels):
    with pytest.raises((ValueError, TypeError), match="raised"):
        render_grid(labels, "side")  # pyright: ignore[reportArgumentType]


def test_more_samples_smooth_outlines_and_do_not_move_them(labels):
    hard = render_grid(labels, "camera", SIZE, samples=1).astype(float)
    soft = render_grid(labels, "camera", SIZE, samples=4).astype(float)
    covered = (hard != 255).any(axis=2)
    near = np.ones((3, 3), dtype=np.uint8)
    inner = cv2.erode(covered.astype(np.uint8), near) > 0
    away = cv2.dilate(covered.astype(np.uint8), near) == 0
    assert (soft[away] == 255).all()
    assert np.abs(soft[inner] - hard[inner]).mean() < 12  # edge lines of voxels are finer
    rim = soft[~inner & ~away].sum(axis=1)
    darkest = hard[covered].sum(axis=1).max()
    assert (
        (rim > darkest + 20) & (rim < 3 * 255 - 20)
    ).any()  # neither the voxels' colour nor white


def test_depth_is_along_the_cameras_axis():
    grid = np.zeros(GRID_SHAPE, dtype=np.uint8)
    grid[100, 60:200, 4:20] = CLASS_NAMES.index("building")  # a wall whose face is at x = 20
    camera = car_camera(SIZE)
    image, depth = render_with_depth(grid, camera, samples=1)
    hit = (image != BACKGROUND_COLOR).any(axis=2)
    assert hit.sum() > 1000
    assert np.isinf(depth[~hit]).all()
    np.testing.assert_allclose(depth[hit], 20.0 - 0.33, atol=1e-3)
    fine = render_with_depth(grid, camera, samples=2)[1]
    assert np.isinf(fine).sum() >= np.isinf(depth).sum() - 200
    np.testing.assert_allclose(fine[np.isfinite(fine)], 20.0 - 0.33, atol=1e-3)


def test_objects_have_their_own_colors_and_background_is_pale(labels):
    car, tree = CLASS_NAMES.index("car"), CLASS_NAMES.index("vegetation")
    labels[100:110, 165:180, 2:14] = car
    voxels = np.argwhere(labels == car)
    voxels = voxels[voxels[:, 0] < 80]  # only the nearer car is an object
    owner = (voxels[:, 0] >= 70).astype(np.int32)  # two objects
    painted, palette = paint_objects(labels, voxels, owner, [car])
    seen = {tuple(color) for color in palette[np.unique(painted[painted > 0])].tolist()}
    pale = 0.75 * 255 + 0.25 * CLASS_COLORS[tree]
    expected = [*object_colors(2), UNCLAIMED, pale.astype(np.uint8)]
    assert seen == {tuple(color.tolist()) for color in expected}
    image = render_grid(painted, "bird", (256, 256), palette=palette)
    for color in expected:
        hues = image[(image != 255).any(axis=2)] / 255.0
        hues /= np.linalg.norm(hues, axis=1, keepdims=True)
        assert (np.abs(hues - hue_of(color)).max(axis=1) < 0.03).any()
    assert (labels[tuple(voxels.T)] == car).all()  # painted on a copy


def test_more_than_256_objects():
    labels = np.zeros(GRID_SHAPE, dtype=np.uint8)
    voxels = np.stack(np.unravel_index(np.arange(400) * 3, (256, 256)), axis=1)
    voxels = np.concatenate([voxels, np.zeros((400, 1), dtype=int)], axis=1)
    labels[tuple(voxels.T)] = 1
    painted, palette = paint_objects(labels, voxels, np.arange(400), [1])
    assert len(np.unique(painted[tuple(voxels.T)])) == 400
    image = render_grid(painted, "bird", (512, 512), palette=palette)
    assert (
        (image != BACKGROUND_COLOR).any(axis=2).sum()
    ) == 400 * 4  # no object index is taken for IGNORE


def test_object_colors_differ_and_are_prefixes_of_each_other():
    colors = object_colors(40).astype(int)
    assert (object_colors(12) == colors[:12]).all()
    apart = np.abs(colors[:, None] - colors[None]).sum(axis=2)
    assert apart[~np.eye(40, dtype=bool)].min() >= 40
    assert apart[:12, :12][~np.eye(12, dtype=bool)].min() >= 80
    assert (colors.max(axis=1) - colors.min(axis=1) >= 60).all()  # none is grey
    assert object_colors(0).shape == (0, 3)
    assert len(object_colors(2000)) == 2000
