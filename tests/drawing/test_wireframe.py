"""Box edges in images: clipping, sampling, hidden points."""

import numpy as np
import pytest

from occdetr.drawing.wireframe import (
    EDGES,
    box_edges,
    clip_segments,
    in_front_of,
    sample_segments,
    to_homogeneous,
)
from occdetr.geometry.camera import MIN_DEPTH
from scene_factory import CAMERA, IMAGE_SIZE, project_brute_force


def test_a_box_has_twelve_edges_as_long_as_its_sides():
    edges = box_edges(np.array([[10.0, -2.0, 0.5, 4.0, 2.0, 1.5]]))[0]
    lengths = np.abs(edges[:, 1] - edges[:, 0])
    assert sorted(map(tuple, lengths)) == sorted(
        [(4.0, 0.0, 0.0)] * 4 + [(0.0, 2.0, 0.0)] * 4 + [(0.0, 0.0, 1.5)] * 4
    )
    assert (np.bincount(EDGES.ravel()) == 3).all()
    np.testing.assert_allclose(edges.reshape(-1, 3).min(0), [8.0, -3.0, -0.25])
    np.testing.assert_allclose(edges.reshape(-1, 3).max(0), [12.0, -1.0, 1.25])


def inside_image(points):
    """Which grid-frame points [N, 3] are inside the image."""
    pixels, depth = project_brute_force(points, CAMERA)
    height, width = IMAGE_SIZE
    across = (pixels[:, 0] >= -0.5) & (pixels[:, 0] <= width - 0.5)
    return (depth >= MIN_DEPTH) & across & (pixels[:, 1] >= -0.5) & (pixels[:, 1] <= height - 0.5)


def test_clipped_segments_equal_dense_sampling():
    rng = np.random.default_rng(0)
    segments = rng.normal(size=(300, 2, 3)) * [8.0, 6.0, 2.0] + [4.0, 0.0, 0.0]
    kept, cut = clip_segments(segments, CAMERA)
    found = dict(zip(kept.tolist(), cut, strict=True))
    shares = np.linspace(0, 1, 2001)[:, None]
    crossing = 0
    for index, (start, end) in enumerate(segments):
        walk = start + shares * (end - start)
        seen = np.flatnonzero(inside_image(walk))
        if len(seen) == 0:
            if index in found:  # shorter than a step
                assert np.linalg.norm(found[index][1] - found[index][0]) < 0.03
            continue
        crossing += not inside_image(segments[index]).all()
        np.testing.assert_allclose(found[index], walk[[seen[0], seen[-1]]], atol=0.03)
    assert crossing > 30


def test_segments_are_clipped_at_the_camera_plane():
    segment = np.array([[[-5.0, 0.2, 0.1], [30.0, 0.2, 0.1]]])
    _, cut = clip_segments(segment, CAMERA)
    assert (to_homogeneous(cut, CAMERA)[..., 2] >= MIN_DEPTH - 1e-9).all()
    behind = segment - [40.0, 0.0, 0.0]
    assert len(clip_segments(behind, CAMERA)[0]) == 0


def test_samples_are_evenly_spaced_in_the_image():
    segment = np.array([[[3.0, 0.5, -0.3], [45.0, -6.0, 0.5]]])
    points = sample_segments(segment, CAMERA, 9)[0]
    pixels, _ = project_brute_force(points, CAMERA)
    np.testing.assert_allclose(np.diff(pixels, n=2, axis=0), 0, atol=1e-6)
    along = (points - segment[0, 0]) / (segment[0, 1] - segment[0, 0])
    np.testing.assert_allclose(along, along[:, :1].repeat(3, axis=1))
    np.testing.assert_allclose(along[[0, -1], 0], [0.0, 1.0])


@pytest.mark.parametrize(("distance", "visible"), [(9.0, True), (10.2, True), (12.0, False)])
def test_points_behind_a_surface_are_hidden(distance, visible):
    wall = np.full(IMAGE_SIZE, 10.0)
    point = np.array([[distance + 0.3, 0.0, 0.0]])  # the camera stands 0.3 m ahead of the origin
    assert in_front_of(point, wall, CAMERA, tolerance=0.3).tolist() == [visible]
    assert in_front_of(point, np.full(IMAGE_SIZE, np.inf), CAMERA, tolerance=0.0).all()
