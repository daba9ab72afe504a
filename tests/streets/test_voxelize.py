"""Voxels of surfaces."""

import numpy as np

from occdetr.streets.ground import SURFACES
from occdetr.streets.scene import Solids
from occdetr.streets.solids import BOX, LEAFY_BOX
from occdetr.streets.voxelize import voxelize
from street_solids import flat_terrain


def test_leaf_voxels_have_no_sample_of_a_solid():
    """A hedge around a wall of another class: the wall's voxels have samples of both."""
    wall = [10, 0.0, 0.0, 1, 0, 0.4, 2.0, 1.0, 1, 1, 0, 1.0]
    hedge = [10, 0.0, 0.0, 1, 0, 1.2, 2.5, 1.4, 1, 1, 0, 1.0]

    def voxels(rows, forms, classes):
        kinds = np.array(forms, dtype=np.uint8), np.zeros(len(rows), dtype=np.int32)
        solids = Solids(np.array(rows, dtype=float), *kinds, np.array(classes, dtype=np.uint8))
        return voxelize(solids, flat_terrain(), np.zeros(len(SURFACES), np.uint8), np.eye(4))

    alone = voxels([wall], [BOX], [13]).classes == 13
    for order in ([0, 1], [1, 0]):
        rows, forms = [[wall, hedge][i] for i in order], [[BOX, LEAFY_BOX][i] for i in order]
        both = voxels(rows, forms, [(13, 15)[i] for i in order])
        assert (both.classes[alone] == 15).any()  # leaves outvote the wall in some voxels
        assert not both.leaves[alone].any()
        assert both.leaves[~alone & (both.classes == 15)].all()
