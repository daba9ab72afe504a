"""Clusters of voxels by distance, exact and linear in the number of voxels."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import cc3d
import numba
import numpy as np
from jaxtyping import Float, Int, Int16, Int32, UInt8
from numpy.typing import NDArray

from occdetr.geometry.voxels import VOXEL_SIZE


@dataclass
class Clusters:
    """Clusters of voxels; ``owner`` is the cluster of each voxel (ascending indices)."""

    classes: UInt8[NDArray, " cluster"]
    voxels: Int16[NDArray, "voxel 3"]
    owner: Int32[NDArray, " voxel"]

    def split(self) -> list[Int16[NDArray, "_ 3"]]:
        """The voxels of each cluster."""
        starts = np.searchsorted(self.owner, np.arange(1, len(self.classes)))
        return np.split(self.voxels, starts)


def cluster_voxels(
    labels: UInt8[NDArray, "x y z"],
    classes: Sequence[int],
    distances: Float[NDArray, " class"],
    min_voxels: Float[NDArray, " class"],
) -> Clusters:
    """Exact single-linkage clusters of each of ``classes``.

    ``distances`` (metres, at least two voxels) and ``min_voxels`` are by class id. Two voxels of a
    class are linked if the distance of their centres is at most that of the class. Touching voxels
    are joined first, all classes in one pass (cc3d). Then the connected parts are joined by looking
    up the neighbours within the distance of each of their surface voxels, which is linear in the
    number of voxels. Clusters with fewer than the class's ``min_voxels`` are dropped.
    """
    is_foreground = np.zeros(256, dtype=bool)
    is_foreground[list(classes)] = True
    foreground = np.where(is_foreground[labels], labels, 0).astype(np.uint8)
    parts, num_parts = cc3d.connected_components(foreground, connectivity=26, return_N=True)
    parts = np.ascontiguousarray(parts, dtype=np.int32)
    flat = np.flatnonzero(foreground)
    voxels = np.stack(np.unravel_index(flat, labels.shape), axis=1).astype(np.int16)
    offsets, reach = _neighbour_offsets(distances / VOXEL_SIZE)
    parent = np.arange(num_parts + 1, dtype=np.int32)
    _link(foreground, parts, voxels, offsets, reach, parent)

    owner = parent[parts.reshape(-1)[flat]]  # the smallest part of the cluster, so in scan order
    roots, owner, counts = np.unique(owner, return_inverse=True, return_counts=True)
    class_of = np.zeros(len(roots), dtype=np.uint8)
    class_of[owner] = foreground.reshape(-1)[flat]
    large = counts >= min_voxels[class_of]
    owner = np.where(large, np.cumsum(large) - 1, -1)[owner].astype(np.int32)
    order = np.argsort(owner, kind="stable")[np.count_nonzero(owner < 0) :]
    return Clusters(class_of[large], voxels[order], owner[order])


def _neighbour_offsets(
    radii: Float[NDArray, " class"],
) -> tuple[Int[NDArray, "offset 3"], Int[NDArray, " class"]]:
    """Half of all offsets, shortest first, and the number of them within each class's radius."""
    limit = int(radii.max() + 1e-6)
    span = range(-limit, limit + 1)
    offsets = np.array(list(itertools.product(span, span, span)), dtype=np.int64)
    offsets = offsets[len(offsets) // 2 + 1 :]  # the other half are their negatives
    length = np.sqrt((offsets**2).sum(1))
    order = np.argsort(length, kind="stable")
    return offsets[order], np.searchsorted(length[order], radii + 1e-6, side="right")


@numba.njit(cache=True, nogil=True)
@no_type_check  # numba cannot compile what jaxtyping's import hook wraps
def _link(foreground, parts, voxels, offsets, reach, parent):
    """Union-find, in place: ``parent`` becomes the smallest part of each part's cluster."""
    nx, ny, nz = foreground.shape
    for v in range(len(voxels)):
        x, y, z = np.int64(voxels[v, 0]), np.int64(voxels[v, 1]), np.int64(voxels[v, 2])
        part, label = parts[x, y, z], foreground[x, y, z]
        inner = 0 < x < nx - 1 and 0 < y < ny - 1 and 0 < z < nz - 1
        if inner and (
            parts[x - 1, y, z] == part
            and parts[x + 1, y, z] == part
            and parts[x, y - 1, z] == part
            and parts[x, y + 1, z] == part
            and parts[x, y, z - 1] == part
            and parts[x, y, z + 1] == part
        ):
            continue  # the nearest voxels of two parts are on their surfaces
        for k in range(reach[label]):
            i, j, h = x + offsets[k, 0], y + offsets[k, 1], z + offsets[k, 2]
            if i < 0 or i >= nx or j < 0 or j >= ny or h < 0 or h >= nz:
                continue
            other = parts[i, j, h]
            if other == part or foreground[i, j, h] != label:
                continue
            a, b = part, other
            while parent[a] != a:
                a = parent[a]
            while parent[b] != b:
                b = parent[b]
            if a < b:
                parent[b] = a
            else:
                parent[a] = b
    for p in range(len(parent)):
        parent[p] = parent[parent[p]]
