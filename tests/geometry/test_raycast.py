"""Ray casting against brute-force marching, and camera rays against projection."""

import itertools

import numpy as np
import pytest

from occdetr.geometry.camera import Camera
from occdetr.geometry.raycast import FACE_NORMALS, camera_rays, cast_rays, mark_swept

SHAPE = (9, 7, 5)


def random_rays(rng, count):
    origins = rng.uniform(-4, 12, size=(count, 3))
    targets = rng.uniform(0, 1, size=(count, 3)) * SHAPE
    return origins, targets - origins


def boundaries(origin, direction, limit):
    """Every distance at which a ray crosses a plane between voxels, sorted."""
    crossings = [0.0, limit]
    for o, d in zip(origin, direction, strict=True):
        planes = np.arange(-40, 60)
        if d != 0:
            distances = (planes - o) / d
            crossings.extend(distances[(distances > 0) & (distances < limit)])
    return np.unique(crossings)


def march(grid, origin, direction, limit=60.0):
    """(voxels passed, first occupied voxel or None, its distance) by interval midpoints."""
    direction = direction / np.linalg.norm(direction)
    crossings = boundaries(origin, direction, limit)
    passed = []
    for near, far in itertools.pairwise(crossings):
        if far - near < 1e-9:
            continue
        voxel = np.floor(origin + (near + far) / 2 * direction).astype(int)
        if (voxel < 0).any() or (voxel >= grid.shape).any():
            continue
        passed.append(tuple(voxel))
        if grid[tuple(voxel)]:
            return passed, tuple(voxel), near
    return passed, None, np.inf


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cast_equals_brute_force(seed):
    rng = np.random.default_rng(seed)
    grid = rng.random(SHAPE) < 0.1
    origins, directions = random_rays(rng, 300)
    hits, distances, faces = cast_rays(grid, origins, directions)
    for ray in range(len(origins)):
        _, voxel, distance = march(grid, origins[ray], directions[ray])
        assert tuple(hits[ray]) == (voxel or (-1, -1, -1))
        assert distances[ray] == pytest.approx(distance, abs=1e-4)
        if voxel is None or distance == 0:
            assert faces[ray] == -1
            continue
        unit = directions[ray] / np.linalg.norm(directions[ray])
        axis, positive = faces[ray] // 2, faces[ray] % 2
        point = origins[ray] + distance * unit
        assert point[axis] == pytest.approx(voxel[axis] + positive, abs=1e-4)
        assert FACE_NORMALS[faces[ray]] @ unit < 0


@pytest.mark.parametrize("limit", [2.5, 100.0])
def test_beams_mark_what_marching_passes(limit):
    rng = np.random.default_rng(3)
    grid = (rng.random(SHAPE) < 0.05).astype(np.uint8)
    for _ in range(10):
        origin = rng.uniform(0, 1, 3) * SHAPE
        azimuths, elevations = rng.uniform(-np.pi, np.pi, 4), rng.uniform(-1.5, 1.5, 3)
        seen, expected = np.zeros(SHAPE, dtype=np.uint8), np.zeros(SHAPE, dtype=np.uint8)
        mark_swept(grid, origin, azimuths, elevations, limit, seen)
        for azimuth in azimuths:
            for up in elevations:
                flat = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(up)
                passed, _, _ = march(grid, origin, np.array([*flat, np.sin(up)]), min(limit, 60.0))
                for voxel in passed:
                    expected[voxel] = 1
        np.testing.assert_array_equal(seen, expected)


def test_axis_aligned_rays_on_boundaries():
    grid = np.zeros((4, 4, 4), dtype=bool)
    grid[1, 1, 1] = grid[3, 3, 3] = True
    origins = np.array([[-1, 1, 1.5], [4, 1.5, 1.5], [2, 1.5, 1.5], [1.5, 1.5, 1.5], [9, 9, 9]])
    directions = np.array([[1.0, 0, 0], [-5, 0, 0], [-1, 0, 0], [0, 0, 1], [-2, -2, -2]])
    hits, distances, faces = cast_rays(grid, origins, directions)
    np.testing.assert_array_equal(hits, [[1, 1, 1]] * 4 + [[3, 3, 3]])
    np.testing.assert_allclose(distances, [2, 2, 0, 0, 5 * 3**0.5], rtol=1e-6)
    assert faces[:2].tolist() == [0, 1]
    assert faces[3] == -1


def test_max_distance_and_misses():
    grid = np.ones((2, 2, 2), dtype=bool)
    origins = np.array([[-3, 1, 1.0]] * 3)
    directions = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1]])
    assert (cast_rays(grid, origins, directions, 2.9)[0] == -1).all()
    assert cast_rays(grid, origins, directions, 3.1)[0][:, 0].tolist() == [0, -1, -1]
    empty = cast_rays(grid, np.zeros((0, 3)), np.zeros((0, 3)))
    assert [len(part) for part in empty] == [0, 0, 0]


def test_invalid_input_is_rejected():
    grid = np.zeros((2, 2, 2), dtype=bool)
    with pytest.raises(TypeError, match="bool or uint8"):
        cast_rays(grid.astype(float), np.zeros((1, 3)), np.ones((1, 3)))
    with pytest.raises(ValueError, match="zero or NaN"):
        cast_rays(grid, np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises((ValueError, TypeError), match="seen"):
        mark_swept(grid, np.zeros(3), np.zeros(1), np.zeros(1), 1.0, grid.view(np.uint8)[:1])


@pytest.mark.parametrize("stride", [1, 3])
def test_camera_rays_project_back_to_their_pixels(stride):
    projection = np.array([[70.0, 0, 60, 45], [0, 71, 18, -0.3], [0, 0, 1, 0.005]])
    lidar_to_camera = np.eye(4)
    lidar_to_camera[:3, :3] = [[0.02, -1, 0], [0, 0.01, -1], [1, 0.02, 0.01]]
    lidar_to_camera[:3, :3] = np.linalg.qr(lidar_to_camera[:3, :3])[0]
    lidar_to_camera[:3, 3] = [0.1, -0.07, -0.3]
    camera = Camera(projection, lidar_to_camera, (36, 120))
    origins, directions = camera_rays(camera, stride)
    for distance in (1.0, 30.0):
        points = np.c_[origins + distance * directions, np.ones(len(origins))]
        image = points @ lidar_to_camera.T @ projection.T
        uv = (image[:, :2] / image[:, 2:]).reshape(36 // stride, 120 // stride, 2)
        middle = (stride - 1) / 2
        np.testing.assert_allclose(uv[0, 0], [middle, middle], atol=1e-8)
        np.testing.assert_allclose(uv[2, 5], [5 * stride + middle, 2 * stride + middle], atol=1e-8)
