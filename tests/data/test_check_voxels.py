"""Grids that are one voxel late."""

import numpy as np
import pytest

from occdetr.data.check_voxels import is_one_late, labels_ahead
from scene_factory import empty_grid, one_late, shadows, street


def test_masks_of_release_1_0_are_noticed():
    mask = shadows(street())
    assert not is_one_late(mask)
    assert is_one_late(one_late(mask))
    for constant in (empty_grid() > 0, empty_grid() == 0):
        assert not is_one_late(one_late(constant))


@pytest.mark.parametrize(
    ("late_scan", "late_labels", "ahead"),
    [(False, False, 0), (True, True, 0), (False, True, 1), (True, False, -1)],
)
def test_scan_and_labels_of_two_releases_are_noticed(late_scan, late_labels, ahead):
    labels = street() > 0
    scan = labels & (np.random.default_rng(0).random(labels.shape) < 0.1)
    scan = one_late(scan) if late_scan else scan
    assert labels_ahead(scan, one_late(labels) if late_labels else labels) == ahead


def test_an_empty_scan_says_nothing():
    assert labels_ahead(empty_grid() > 0, street() > 0) == 0
