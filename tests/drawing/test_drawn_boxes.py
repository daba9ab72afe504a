"""2D and 3D boxes on images."""

import numpy as np
import pytest

from occdetr.classes import CLASS_COLORS, CLASS_NAMES
from occdetr.drawing.boxes import BACKGROUND_COLOR, draw_boxes, draw_boxes3d, draw_named_boxes
from occdetr.drawing.grids import (
    bird_camera,
    car_camera,
    raised_camera,
    render_grid,
    render_with_depth,
)
from occdetr.drawing.wireframe import box_edges, to_homogeneous
from occdetr.geometry.voxels import GRID_SHAPE, voxels_to_box
from voxel_scenes import SIZE, car_and_vegetation

RED = np.array([[255, 0, 0]], dtype=np.uint8)


@pytest.fixture
def labels():
    return car_and_vegetation()


def test_2d_boxes_are_drawn_on_a_copy():
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    boxes = np.array([[20.2, 30.0, 60.0, 80.0], [-30.0, -10.0, 400.0, 500.0]])
    drawn = draw_boxes(image, boxes, [1, 19], [0.9, 0.4])
    assert not image.any()
    assert (drawn[80, 40] == CLASS_COLORS[1]).all()
    none = draw_boxes(image, np.zeros((0, 4)), [])
    assert (none == image).all()


def test_tags_do_not_cover_each_other():
    """Twenty boxes at nearly one place: the best ones have a tag, each whole."""
    image, text = np.full((400, 600, 3), 7, dtype=np.uint8), "traffic-sign 0.50"
    colors = np.array([[255 - index, 10 + index, 200] for index in range(20)], dtype=np.uint8)
    boxes = np.array([[300 + k, 200 + k, 330 + k, 260 + k] for k in range(20)], dtype=float)
    alone = draw_named_boxes(image, boxes[-1:], colors[-1:], [text])
    drawn = draw_named_boxes(image, boxes, colors, [text] * 20)
    whole = (alone == colors[-1]).all(-1).sum()  # of its lines and its tag
    areas = [(drawn == color).all(-1).sum() for color in colors]
    assert areas[-1] > 0.85 * whole
    tagged = [area > 0.35 * whole for area in areas]
    assert 3 <= sum(tagged) < 20


def blank(size=SIZE):
    return np.full((*size, 3), 255, dtype=np.uint8)


@pytest.mark.parametrize("camera", [raised_camera, car_camera, bird_camera])
def test_3d_boxes_are_drawn_along_their_projected_edges(camera):
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
def test_lines_match_the_birds_eye_view(size):
    grid = np.zeros(GRID_SHAPE, dtype=np.uint8)
    grid[40:75, 120:180, 3:9] = 1
    box = voxels_to_box(np.argwhere(grid))[None]
    corners = to_homogeneous(box_edges(box)[0].reshape(-1, 3), bird_camera(size))[:, :2] + 0.5
    rows, columns = np.nonzero((render_grid(grid, "bird", size) != BACKGROUND_COLOR).any(axis=2))
    bounds = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    np.testing.assert_allclose(np.concatenate([corners.min(0), corners.max(0)]), bounds, atol=1.01)


def test_hidden_edges_are_faint():
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


def test_an_object_hides_only_its_own_back_edges(labels):
    labels[66:80] = 0  # 1.2 m long, so that no two edges lie over each other
    labels[:, :, 0:2] = CLASS_NAMES.index("road")
    camera = raised_camera((480, 640))
    box = voxels_to_box(np.argwhere(labels == CLASS_NAMES.index("car")))[None]
    depth = render_with_depth(labels, camera, samples=1)[1]
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


def test_3d_boxes_behind_and_around_the_camera():
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
