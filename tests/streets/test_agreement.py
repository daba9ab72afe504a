"""Agreement of pixels and voxels."""

import numpy as np
import pytest

from occdetr.geometry.kitti import kitti_camera
from occdetr.geometry.voxels import GRID_ORIGIN, VOXEL_SIZE
from occdetr.streets.agreement import compare_pixels, pixel_classes, silhouettes
from occdetr.streets.trace import NOTHING
from occdetr.streets.world import World

CAMERA = kitti_camera((120, 396))


@pytest.fixture(scope="module")
def snapshot():
    return World(seed=0, split=0, index=7).snapshot()


@pytest.mark.parametrize(("index", "tilted"), [(1, False), (4, False), (9, False), (4, True)])
def test_pixels_and_voxels_agree(index, tilted):
    snapshot = World(seed=0, split=1, index=index, tilted=tilted).snapshot()
    view, voxels = snapshot.view(CAMERA), snapshot.voxels()
    agreement = compare_pixels(snapshot, view, CAMERA, voxels.classes, snapshot.sweep(voxels))
    assert agreement.pixels > 5_000
    assert agreement.same / agreement.pixels > 0.97
    assert agreement.known / agreement.pixels > 0.5
    assert agreement.known_same / agreement.known > 0.95


def test_pixels_do_not_agree_with_mirrored_voxels():
    snapshot = World(seed=0, split=1, index=4).snapshot()
    view, voxels = snapshot.view(CAMERA), snapshot.voxels()
    mirrored = np.ascontiguousarray(voxels.classes[:, ::-1])
    agreement = compare_pixels(snapshot, view, CAMERA, mirrored, snapshot.sweep(voxels))
    assert agreement.same / agreement.pixels < 0.9


def test_surfaces_are_in_or_next_to_voxels_of_their_class(snapshot):
    """Surfaces are sampled, so a voxel with only a corner in a surface may be empty."""
    view, voxels = snapshot.view(CAMERA), snapshot.voxels()
    classes = pixel_classes(snapshot, view)
    met = np.flatnonzero(view.hits.solids != NOTHING)
    points = view.origins[met] + view.hits.distances[met, None] * view.directions[met]
    cells = np.floor((points - GRID_ORIGIN) / VOXEL_SIZE).astype(int)
    within = ((cells >= 1) & (cells < np.array(voxels.classes.shape) - 1)).all(axis=1)
    cells, classes = cells[within], classes[met][within]
    found = voxels.classes[tuple(cells.T)]
    assert (found[found > 0] == classes[found > 0]).mean() > 0.93
    around = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    beside = [voxels.classes[tuple((cells + shift).T)] == classes for shift in around]
    assert np.any(beside, axis=0).mean() > 0.99


def test_silhouettes_are_one_voxel_wide():
    classes = np.zeros((60, 60), dtype=np.uint8)
    classes[:, 30:] = 3
    depth = np.full((60, 60), 20.0)
    depth[:, 30:] = 10.0
    edges = silhouettes(classes, depth, focal=200.0)  # 0.2 m at 10 m: 4 pixels
    np.testing.assert_array_equal(np.flatnonzero(edges[30]), np.arange(25, 35))
