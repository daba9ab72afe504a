"""Clusters of voxels against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from occdetr.data.clusters import cluster_voxels
from occdetr.data.objects import ObjectSettings
from occdetr.geometry.voxels import VOXEL_SIZE


@pytest.mark.parametrize("distance", [0.4, 0.6, 1.0, 1.3])
@pytest.mark.parametrize("density", [0.002, 0.01, 0.1])
def test_clusters_equal_brute_force(distance: float, density: float) -> None:
    rng = np.random.default_rng(7)
    labels = np.where(rng.random((22, 19, 13)) < density, rng.integers(1, 4, (22, 19, 13)), 0)
    labels = labels.astype(np.uint8)
    settings = ObjectSettings(
        classes=(1, 2), distance={"default": distance}, min_voxels={"default": 1, "bicycle": 1}
    )
    clusters = cluster_voxels(
        labels, settings.classes, settings.distance_table(), settings.min_voxels_table()
    )
    ours = {
        (int(class_id), frozenset(map(tuple, voxels.tolist())))
        for class_id, voxels in zip(clusters.classes, clusters.split(), strict=True)
    }
    assert ours == _brute_force_clusters(labels, (1, 2), distance)
    assert (labels[tuple(clusters.voxels.T)] == clusters.classes[clusters.owner]).all()


def _brute_force_clusters(
    labels: np.ndarray, classes: tuple[int, ...], distance: float
) -> set[tuple[int, frozenset]]:
    expected = set()
    for class_id in classes:
        voxels = np.argwhere(labels == class_id)
        pairs = cKDTree(voxels * VOXEL_SIZE).query_pairs(distance + 1e-6, output_type="ndarray")
        shape = (len(voxels), len(voxels))
        graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape)
        count, member = connected_components(graph, directed=False)
        for index in range(count):
            cluster = frozenset(map(tuple, voxels[member == index].tolist()))
            expected.add((class_id, cluster))
    return expected
