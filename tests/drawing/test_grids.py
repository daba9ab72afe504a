"""Pictures of grids: the right class at the right place, from every view."""

import cv2
import numpy as np
import pytest

from occdetr.classes import CLASS_COLORS, CLASS_NAMES, IGNORE
from occdetr.drawing.boxes import BACKGROUND, class_legend, draw_boxes, draw_boxes3d
from occdetr.drawing.grids import (
    UNCLAIMED,
    bird_camera,
    car_camera,
    object_colors,
    paint_objects,
    raised_camera,
    render_grid,
    render_with_depth,
    scene_panel,
)
from occdetr.drawing.wireframe import box_edges, to_homogeneous
from occdetr.geometry.camera import project_points, transform_points
from occdetr.geometry.voxels import GRID_SHAPE, voxel_centers, voxels_to_box

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


# ----------------------------------------------------------------------- rays, several a pixel


def test_more_rays_soften_outlines_and_move_nothing(labels):
    hard = render_grid(labels, "camera", SIZE, samples=1).astype(float)
    soft = render_grid(labels, "camera", SIZE, samples=4).astype(float)
    covered = (hard != 255).any(axis=2)
    near = np.ones((3, 3), dtype=np.uint8)
    inner = cv2.erode(covered.astype(np.uint8), near) > 0
    away = cv2.dilate(covered.astype(np.uint8), near) == 0
    assert (soft[away] == 255).all()
    assert np.abs(soft[inner] - hard[inner]).mean() < 12  # edges of voxels, finer drawn
    rim = soft[~inner & ~away].sum(axis=1)
    darkest = hard[covered].sum(axis=1).max()
    assert ((rim > darkest + 20) & (rim < 3 * 255 - 20)).any()  # neither voxel nor sky


def test_depth_is_along_the_axis_of_the_camera():
    grid = np.zeros(GRID_SHAPE, dtype=np.uint8)
    grid[100, 60:200, 4:20] = CLASS_NAMES.index("building")  # a wall whose face is at x = 20
    camera = car_camera(SIZE)
    image, depth = render_with_depth(grid, SIZE, camera, samples=1)
    hit = (image != BACKGROUND).any(axis=2)
    assert hit.sum() > 1000
    assert np.isinf(depth[~hit]).all()
    np.testing.assert_allclose(depth[hit], 20.0 - 0.33, atol=1e-3)
    fine = render_with_depth(grid, SIZE, camera, samples=2)[1]
    assert np.isinf(fine).sum() >= np.isinf(depth).sum() - 200
    np.testing.assert_allclose(fine[np.isfinite(fine)], 20.0 - 0.33, atol=1e-3)


# ------------------------------------------------------------------- objects in their own colours


def test_objects_have_their_colors_and_the_rest_is_pale(labels):
    car, tree = CLASS_NAMES.index("car"), CLASS_NAMES.index("vegetation")
    labels[100:110, 165:180, 2:14] = car
    voxels = np.argwhere(labels == car)
    voxels = voxels[voxels[:, 0] < 80]  # the nearer car is an object, the farther one none
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


def test_more_objects_than_a_byte_holds():
    labels = np.zeros(GRID_SHAPE, dtype=np.uint8)
    voxels = np.stack(np.unravel_index(np.arange(400) * 3, (256, 256)), axis=1)
    voxels = np.concatenate([voxels, np.zeros((400, 1), dtype=int)], axis=1)
    labels[tuple(voxels.T)] = 1
    painted, palette = paint_objects(labels, voxels, np.arange(400), [1])
    assert len(np.unique(painted[tuple(voxels.T)])) == 400
    image = render_grid(painted, "bird", (512, 512), palette=palette)
    assert ((image != BACKGROUND).any(axis=2).sum()) == 400 * 4  # none is taken for unknown


def test_object_colors_are_far_apart_and_do_not_depend_on_their_number():
    colors = object_colors(40).astype(int)
    assert (object_colors(12) == colors[:12]).all()
    apart = np.abs(colors[:, None] - colors[None]).sum(axis=2)
    assert apart[~np.eye(40, dtype=bool)].min() >= 40
    assert apart[:12, :12][~np.eye(12, dtype=bool)].min() >= 80
    assert (colors.max(axis=1) - colors.min(axis=1) >= 60).all()  # none is grey
    assert object_colors(0).shape == (0, 3)
    assert len(object_colors(2000)) == 2000


# -------------------------------------------------------------------------------- 3D boxes

RED = np.array([[255, 0, 0]], dtype=np.uint8)


def blank(size=SIZE):
    return np.full((*size, 3), 255, dtype=np.uint8)


@pytest.mark.parametrize("camera", [raised_camera, car_camera, bird_camera])
def test_a_box_is_drawn_along_its_projected_edges(camera):
    box = np.array([[25.0, 4.0, -0.5, 6.0, 3.0, 2.0]])
    drawn = draw_boxes3d(blank(), box, RED, camera(SIZE))
    lines = np.linspace(0, 1, 50)[:, None, None] * np.diff(box_edges(box)[0], axis=1)[None, :, 0]
    points = box_edges(box)[0][None, :, 0] + lines
    homogeneous = to_homogeneous(points, camera(SIZE))
    u, v = np.moveaxis(np.rint(homogeneous[..., :2] / homogeneous[..., 2:]).astype(int), -1, 0)
    assert (drawn[v, u] != 255).any(axis=-1).mean() > 0.99
    on_lines = np.zeros(SIZE, dtype=bool)
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            on_lines[v + row, u + column] = True
    assert (drawn[~on_lines] == 255).all()


@pytest.mark.parametrize("size", [(256, 256), (100, 150), (300, 220), (700, 640)])
def test_the_map_and_the_lines_over_it_agree(size):
    grid = np.zeros(GRID_SHAPE, dtype=np.uint8)
    grid[40:75, 120:180, 3:9] = 1
    box = voxels_to_box(np.argwhere(grid))[None]
    corners = to_homogeneous(box_edges(box)[0].reshape(-1, 3), bird_camera(size))[:, :2] + 0.5
    rows, columns = np.nonzero((render_grid(grid, "bird", size) != BACKGROUND).any(axis=2))
    bounds = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    np.testing.assert_allclose(np.concatenate([corners.min(0), corners.max(0)]), bounds, atol=1.01)


def test_hidden_edges_are_fainter():
    box, camera = np.array([[25.0, 0.0, 0.0, 4.0, 2.0, 2.0]]), car_camera(SIZE)
    ink = {
        name: 255 - draw_boxes3d(blank(), box, RED, camera, depth)[..., 1].astype(int)
        for name, depth in (
            ("free", np.full(SIZE, np.inf)),
            ("behind", np.full(SIZE, 10.0)),
            ("half", np.where(np.arange(SIZE[1]) < SIZE[1] / 2, 10.0, np.inf) + np.zeros(SIZE)),
        )
    }
    assert ink["free"].max() > 240
    assert 100 < ink["behind"].max() < 140
    np.testing.assert_array_equal(ink["behind"] > 0, ink["free"] > 0)
    middle = SIZE[1] // 2
    assert ink["half"][:, : middle - 2].max() == ink["behind"].max()
    assert ink["half"][:, middle + 2 :].max() == ink["free"].max()


def test_the_own_front_of_an_object_hides_only_its_back(labels):
    labels[66:80] = 0  # 1.2 m long, so that no two edges lie over each other
    labels[:, :, 0:2] = CLASS_NAMES.index("road")
    camera = raised_camera((480, 640))
    box = voxels_to_box(np.argwhere(labels == CLASS_NAMES.index("car")))[None]
    depth = render_with_depth(labels, (480, 640), camera, samples=1)[1]
    drawn = draw_boxes3d(blank((480, 640)), box, RED, camera, depth)
    lower, upper = box[0, :3] - box[0, 3:] / 2, box[0, :3] + box[0, 3:] / 2

    def ink_at(x, y, z):
        u, v, w = to_homogeneous(np.array([x, y, z]), camera)
        patch = drawn[round(v / w) - 1 : round(v / w) + 2, round(u / w) - 1 : round(u / w) + 2]
        return 255 - patch[..., 1].min()

    middle = box[0, 1]
    assert ink_at(lower[0], middle, lower[2]) > 200  # near edge, on the road
    assert ink_at(lower[0], middle, upper[2]) > 200
    assert ink_at(upper[0], middle, upper[2]) > 200  # far edge of the roof
    assert ink_at(upper[0], middle, lower[2]) < 140  # far edge on the road


def test_boxes_beside_behind_and_around_the_camera():
    image, camera = blank(), car_camera(SIZE)
    behind = np.array([[-10.0, 0.0, 0.0, 4.0, 2.0, 2.0]])
    assert (draw_boxes3d(image, behind, RED, camera) == 255).all()
    none = draw_boxes3d(image, np.zeros((0, 6)), np.zeros((0, 3), dtype=np.uint8), camera)
    assert (none == 255).all()
    around = np.array([[0.0, 3.0, -0.8, 12.0, 2.0, 1.6]])  # a car that passes to the left
    drawn = draw_boxes3d(image, around, RED, camera)
    assert (drawn[:, :80] != 255).any()
    assert (drawn[:, 81:] == 255).all()
    assert (image == 255).all()
