"""Metres, voxel units and indices of the grid."""

import numpy as np

from occdetr.geometry import voxels

SHAPE = voxels.GRID_SHAPE


def test_corners_of_the_grid_in_metres_and_voxels():
    corner = np.array(voxels.GRID_ORIGIN)
    np.testing.assert_allclose(voxels.metres_to_voxels(corner), 0, atol=1e-12)
    far = corner + voxels.GRID_SIZE
    np.testing.assert_allclose(voxels.metres_to_voxels(far), SHAPE, atol=1e-9)
    np.testing.assert_allclose(voxels.voxel_centers(np.zeros(3, int)), corner + 0.1)


def test_voxel_centers_map_to_their_indices():
    rng = np.random.default_rng(3)
    indices = rng.integers(0, SHAPE, (1000, 3))
    np.testing.assert_array_equal(voxels.points_to_indices(voxels.voxel_centers(indices)), indices)
    assert voxels.inside_grid(indices).all()
    assert not voxels.inside_grid(np.array([[-1, 0, 0], [0, 256, 0], [0, 0, 32]])).any()


def test_boxes_cover_whole_voxels():
    box = voxels.voxels_to_box(np.array([[10, 128, 10], [19, 128, 14]], dtype=np.int16))
    np.testing.assert_allclose(box, [3.0, 0.1, 0.5, 2.0, 0.2, 1.0], atol=1e-9)


def test_metres_to_voxels_and_back():
    points = np.random.default_rng(4).uniform(-30, 60, (50, 3))
    there = voxels.metres_to_voxels(points)
    np.testing.assert_allclose(voxels.voxels_to_metres(there), points, atol=1e-12)
    np.testing.assert_allclose(
        voxels.metres_to_voxels(np.array([0.1, -25.6, 0.0])), [0.5, 0.0, 10.0]
    )
