"""Voxel grids that are one voxel late, as SemanticKITTI's release 1.0 has them.

Its writer began at the second voxel of a file: each value lies one voxel higher, and the highest of
a column in the lowest voxel of the next one (PRBonn/semantic-kitti-api, issue 49). Version 1.1
corrected that.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

#: By how much the agreement of neighbours must differ, as a share of voxels.
_MARGIN = 0.05


def is_one_late(mask: Bool[np.ndarray, "256 256 32"]) -> bool:
    """Whether a mask of large regions, ``.invalid`` or ``.occluded``, is one voxel late.

    The lowest voxel of a column then equals the highest of the column before more often than the
    voxel above it.
    """
    lowest = mask[:, 1:, 0]
    above = np.mean(lowest == mask[:, 1:, 1])
    before = np.mean(lowest == mask[:, :-1, -1])
    return bool(before - above > _MARGIN)


def labels_ahead(
    scan: Bool[np.ndarray, "256 256 32"], labelled: Bool[np.ndarray, "256 256 32"]
) -> int:
    """By how many voxels (-1, 0 or 1) the labels lie behind the scan in their files: the shift at
    which most voxels of the scan have a label.

    It is 0 if both are of one release, because the labels contain the scan.
    """
    hits = np.flatnonzero(scan.reshape(-1)[1:-1]) + 1
    if not len(hits):
        return 0
    flat = labelled.reshape(-1)
    shares = {shift: float(np.mean(flat[hits + shift])) for shift in (0, 1, -1)}
    best = max(shares, key=lambda shift: shares[shift])
    return best if shares[best] - shares[0] > _MARGIN else 0
