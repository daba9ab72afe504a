"""Bands of distance: disjoint, and together the whole grid."""

import numpy as np
import torch

from occdetr.evaluation.distance import band_of, band_slices
from occdetr.geometry.voxels import voxel_centers


def test_slices_hold_the_voxels_with_centres_in_the_band():
    x = voxel_centers(np.stack([np.arange(256), *np.zeros((2, 256), int)], axis=1))[:, 0]
    bands = band_of(torch.from_numpy(x))
    expected = np.digitize(x, [12.8, 25.6])
    np.testing.assert_array_equal(bands.numpy(), expected)
    for number, part in enumerate(band_slices()):
        np.testing.assert_array_equal(np.arange(256)[part], np.flatnonzero(expected == number))
