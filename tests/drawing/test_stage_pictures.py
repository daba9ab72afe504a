"""Pictures of what the network computes on the way: the right colours at the right places."""

import numpy as np

from occdetr.drawing.grids import render_grid
from occdetr.drawing.stages import draw_samples, feature_picture, heat_picture, paint_cells
from occdetr.geometry.voxels import GRID_SHAPE

DARK, BRIGHT = np.array([68, 1, 84]), np.array([253, 231, 37])  # the ends of viridis


def test_similar_features_have_similar_colors():
    rng = np.random.default_rng(0)
    features = rng.normal(0, 0.01, (4, 6, 16))
    features[:, 3:] += rng.normal(0, 1, 16)  # another kind of thing on the right
    picture = feature_picture(features, (40, 60)).astype(int)
    assert picture.shape == (40, 60, 3)
    left, right = picture[:, :30, 0], picture[:, 30:, 0]  # the first component is red
    assert abs(left.mean() - right.mean()) > 80
    assert max(left.std(), right.std()) < 10
    assert (picture[:10, :10] == picture[0, 0]).all()  # a cell is a block of pixels


def test_features_that_are_all_equal_are_gray():
    assert (feature_picture(np.ones((2, 3, 8)), (20, 30)) == 128).all()


def test_heat_goes_from_dark_to_bright_up_to_the_most():
    picture = heat_picture(np.array([[0.0, 0.25, 0.5, 2.0]]), (10, 40), most=0.5)
    np.testing.assert_allclose(picture[5, 5], DARK, atol=2)
    np.testing.assert_allclose(picture[5, 25], BRIGHT, atol=4)
    np.testing.assert_array_equal(picture[5, 25], picture[5, 35])
    assert DARK.sum() < picture[5, 15].sum() < BRIGHT.sum()


def test_samples_are_where_they_are_and_large_by_weight():
    image = np.full((80, 160, 3), 200, np.uint8)
    points = np.array([[0.25, 0.5], [0.75, 0.25], [5.0, 5.0]])  # the last one is outside
    picture = draw_samples(image, points, np.array([0.6, 0.1, 0.3]))
    changed = (picture != 200).any(-1)
    np.testing.assert_allclose(picture[39:41, 39:41].mean((0, 1)), BRIGHT, atol=4)
    assert picture[19:21, 119:121].mean() < 120
    assert changed[:, :80].sum() > 1.5 * changed[:, 80:].sum() > 0
    assert (image == 200).all()  # the given one is as it was


def test_cells_fill_their_voxels_in_the_color_of_their_value():
    grid, palette = paint_cells(np.array([[0, 1, 0], [1, 1, 0]]), 8, np.array([0.0, 1.0]))
    assert grid.shape == GRID_SHAPE
    assert (grid[:8, 8:16, :8] == grid[0, 8, 0]).all()
    assert (grid > 0).sum() == 2 * 8**3
    low, high = palette[grid[0, 8, 0]], palette[grid[8, 8, 0]]
    assert low.sum() < high.sum()
    assert abs(low - 0.82 * DARK).max() < 3  # every other cell is a little darker
    np.testing.assert_allclose(high, BRIGHT, atol=4)
    above = render_grid(grid, "bird", (64, 64), palette)
    assert (above.min(-1) < 250).sum() == 2 * 2 * 2  # pixels of four voxels
