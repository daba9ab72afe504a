"""Visibility against brute force: points on each ray, 1 cm apart, on small grids and on all pixels
of the real frames (``pytest tests/data/test_visibility.py -m slow -s`` prints the differences)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
import pytest

from occdetr.classes import CLASS_NAMES, IGNORE
from occdetr.data.clusters import cluster_voxels
from occdetr.data.frames import find_frames
from occdetr.data.objects import (
    MIN_SHARE_IN_VIEW,
    ObjectSettings,
    SceneObjects,
    extract_objects,
)
from occdetr.data.semantickitti import read_labels
from occdetr.files import image_size_of
from occdetr.geometry.camera import MIN_DEPTH, Camera
from occdetr.geometry.kitti import read_camera
from occdetr.geometry.raycast import camera_rays, cast_rays
from occdetr.geometry.voxels import VOXEL_SIZE, metres_to_voxels, voxels_to_metres
from scene_factory import REAL_ROOT, REAL_SEQUENCES, project_brute_force

STEP = 0.01 / VOXEL_SIZE  # 1 cm, in voxels
SIZE = (48, 68)
SHAPE = (16, 14, 9)
CAR, BUILDING = CLASS_NAMES.index("car"), CLASS_NAMES.index("building")
POLE, TRUCK = CLASS_NAMES.index("pole"), CLASS_NAMES.index("truck")
#: Objects of any size, a ray for each pixel.
EVERY_VOXEL = ObjectSettings(
    distance={"default": 0.4},
    min_voxels=dict.fromkeys(("default", "pole", "traffic-sign", "person", "bicycle"), 1),
    ray_stride=1,
)


@dataclass
class Hits:
    """First voxels that rays hit, -1 where none, and the distances in voxels."""

    voxels: np.ndarray
    distances: np.ndarray

    def found(self) -> np.ndarray:
        """Which rays hit anything."""
        return self.voxels[:, 0] >= 0

    def on(self, marked: np.ndarray) -> np.ndarray:
        """Which rays hit a marked voxel."""
        return self.found() & marked[tuple(self.voxels.T)]


def look_at(eye: np.ndarray, target: np.ndarray, roll: float, focal: float) -> Camera:
    """A camera at ``eye`` (grid-frame metres) with a principal point off the image's centre and a
    fourth column of the projection, as KITTI's."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    right = np.cos(roll) * right + np.sin(roll) * np.cross(ahead, right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    lidar_to_camera = np.eye(4)
    lidar_to_camera[:3, :3], lidar_to_camera[:3, 3] = rotation, -rotation @ eye
    projection = [[focal, 0, 32.3, 0.9], [0, focal, 24.8, -0.2], [0, 0, 1, 0.004]]
    return Camera(np.array(projection), lidar_to_camera, SIZE)


def random_camera(rng: np.random.Generator) -> Camera:
    """A camera outside a grid of ``SHAPE`` that looks somewhere into it."""
    middle = voxels_to_metres(np.array(SHAPE) / 2)
    direction = rng.normal(size=3)
    eye = middle + rng.uniform(2.5, 5.0) * direction / np.linalg.norm(direction)
    target = middle + rng.uniform(-0.8, 0.8, 3)
    return look_at(eye, target, rng.uniform(-0.5, 0.5), rng.uniform(40, 70))


def pixel_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Camera centre (voxel units) and a unit direction for each pixel, from the product [3, 4] of
    the camera's matrices."""
    matrix = camera.projection @ camera.lidar_to_camera
    center = metres_to_voxels(-np.linalg.solve(matrix[:, :3], matrix[:, 3]))
    height, width = camera.image_size
    v, u = np.mgrid[0:height, 0:width]
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    directions = np.linalg.solve(matrix[:, :3], pixels).T
    return center, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def march(occupied: np.ndarray, camera: Camera) -> Hits:
    """The first of the points, 1 cm apart, on each pixel's ray that is in an occupied voxel. Voxels
    that contain less than one step of the ray can be missed."""
    center, directions = pixel_rays(camera)
    hits = Hits(np.full((len(directions), 3), -1), np.full(len(directions), np.inf))
    _first_points(occupied, center, directions, hits.voxels, hits.distances)
    return hits


def count_rays(owner: np.ndarray, number: int, camera: Camera) -> np.ndarray:
    """By object (1 to ``number`` in ``owner``) the pixels whose ray has a point in it, hidden or
    not."""
    center, directions = pixel_rays(camera)
    counts, last = np.zeros(number + 1, dtype=int), np.full(number + 1, -1)
    _count_points(owner, center, directions, counts, last)
    return counts[1:]


@numba.njit(cache=True, nogil=True)
def _point(center, direction, distance):
    x = math.floor(center[0] + distance * direction[0])
    y = math.floor(center[1] + distance * direction[1])
    z = math.floor(center[2] + distance * direction[2])
    return x, y, z


@numba.njit(cache=True, nogil=True)
def _steps(center, direction, shape):
    """Steps after which a ray has left the grid for good."""
    leaves = np.inf
    for axis in range(3):
        if direction[axis] != 0:
            side = shape[axis] if direction[axis] > 0 else 0
            leaves = min(leaves, (side - center[axis]) / direction[axis])
    return max(math.ceil(leaves / STEP) + 1, 0)


@numba.njit(cache=True, nogil=True)
def _first_points(occupied, center, directions, voxels, distances):
    for ray in range(len(directions)):
        for step in range(_steps(center, directions[ray], occupied.shape)):
            x, y, z = _point(center, directions[ray], step * STEP)
            inside = 0 <= x < occupied.shape[0] and 0 <= y < occupied.shape[1]
            if inside and 0 <= z < occupied.shape[2] and occupied[x, y, z]:
                voxels[ray] = x, y, z
                distances[ray] = step * STEP
                break


@numba.njit(cache=True, nogil=True)
def _count_points(owner, center, directions, counts, last):
    for ray in range(len(directions)):
        for step in range(_steps(center, directions[ray], owner.shape)):
            x, y, z = _point(center, directions[ray], step * STEP)
            inside = 0 <= x < owner.shape[0] and 0 <= y < owner.shape[1]
            if inside and 0 <= z < owner.shape[2]:
                index = owner[x, y, z]
                counts[index] += last[index] != ray
                last[index] = ray


def cast(occupied: np.ndarray, camera: Camera) -> Hits:
    """The same by ``cast_rays``."""
    origins, directions = camera_rays(camera)
    voxels, distances, _ = cast_rays(occupied, metres_to_voxels(origins), directions)
    return Hits(voxels, distances.astype(float))


def chords(voxels: np.ndarray, camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Length of the given rays within the given voxels, one for each, in voxels."""
    center, directions = pixel_rays(camera)
    with np.errstate(divide="ignore"):
        planes = (np.stack([voxels, voxels + 1]) - center) / directions[rays]
    return planes.max(0).min(1) - planes.min(0).max(1)


def random_labels(rng: np.random.Generator) -> np.ndarray:
    """Blocks of several classes, scattered voxels, and some that are unknown."""
    labels = np.zeros(SHAPE, dtype=np.uint8)
    for _ in range(6):
        lower = rng.integers(0, np.array(SHAPE) - 2)
        upper = lower + rng.integers(1, 5, 3)
        block = tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))
        labels[block] = rng.choice([CAR, TRUCK, POLE, BUILDING])
    scattered = rng.random(SHAPE)
    labels[scattered < 0.01] = CAR
    labels[scattered > 0.96] = IGNORE
    return labels


def camera_inside(rng: np.random.Generator) -> Camera:
    """A camera inside a grid of ``SHAPE``, with voxels on both sides of its plane."""
    eye = voxels_to_metres(rng.uniform(0.35, 0.65, 3) * SHAPE)
    return look_at(eye, eye + rng.normal(size=3), rng.uniform(-0.5, 0.5), rng.uniform(12, 25))


def put_wall(labels: np.ndarray, camera: Camera) -> None:
    """A wall over half of the side of the grid that faces the camera, in place."""
    center = pixel_rays(camera)[0]
    axis = int(np.argmax(np.abs(center - np.array(SHAPE) / 2) / SHAPE))
    side, half = [slice(None)] * 3, (axis + 1) % 3
    side[axis] = slice(0, 1) if center[axis] < SHAPE[axis] / 2 else slice(-1, None)
    side[half] = slice(0, SHAPE[half] // 2)
    labels[tuple(side)] = BUILDING


# ray casting


@pytest.mark.parametrize("seed", range(6))
def test_first_hits_equal_marching(seed: int) -> None:
    """Each ray hits the same voxel at the same distance, except where marching misses a voxel that
    contains less than one step of the ray."""
    rng = np.random.default_rng(seed)
    occupied = rng.random(SHAPE) < 0.05
    camera = random_camera(rng)
    exact, marched = cast(occupied, camera), march(occupied, camera)
    differs = (exact.voxels != marched.voxels).any(1)
    same = exact.found() & ~differs
    assert same.sum() > 300
    assert (~exact.found()).any()

    behind = marched.distances[same] - exact.distances[same]
    assert behind.min() > -1e-6
    assert behind.max() < STEP + 1e-6
    assert exact.found()[differs].all()
    assert occupied[tuple(exact.voxels[differs].T)].all()
    passed_over = chords(exact.voxels[differs], camera, np.flatnonzero(differs))
    assert ((passed_over > 0) & (passed_over < STEP)).all()
    assert (marched.distances[differs] > exact.distances[differs]).all()
    assert differs.sum() < 0.04 * exact.found().sum()


# objects


def brute_force_rays(
    labels: np.ndarray, objects: SceneObjects, camera: Camera
) -> list[tuple[int, int, int]]:
    """For each object the numbers of pixels that show it, that would show it without other voxels,
    and for which marching and ``cast_rays`` disagree."""
    world = (labels != 0) & (labels != IGNORE)
    marched, exact = march(world, camera), cast(world, camera)
    counts = []
    for index in range(len(objects)):
        own = np.zeros(labels.shape, dtype=bool)
        own[tuple(objects.voxels[objects.voxel_object == index].T)] = True
        seen, alone = marched.on(own), march(own, camera).found()
        unsure = (seen != exact.on(own)) | (alone != cast(own, camera).found())
        counts.append((int(seen.sum()), int(alone.sum()), int(unsure.sum())))
    return counts


def check_fractions(objects: SceneObjects, counts: list[tuple[int, int, int]]) -> None:
    """Visible fractions equal the counts, up to the few pixels with different results."""
    for fraction, (seen, alone, unsure) in zip(objects.visible_fraction, counts, strict=True):
        assert (seen - unsure) / (alone + unsure) - 1e-6 <= fraction
        assert fraction <= (seen + unsure) / max(alone - unsure, 1) + 1e-6
    _, alone, unsure = np.array(counts).T
    assert unsure.sum() <= 0.03 * alone.sum()


@pytest.mark.parametrize("seed", range(4))
def test_visible_fraction_equals_marching(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    labels, camera = random_labels(rng), random_camera(rng)
    objects = extract_objects(labels, camera, EVERY_VOXEL)
    assert len(objects) >= 5
    assert objects.visible_fraction.min() < 0.9
    check_fractions(objects, brute_force_rays(labels, objects, camera))


@pytest.mark.parametrize("seed", range(3))
def test_exactly_the_invisible_clusters_are_dropped(seed: int) -> None:
    """Every cluster is an object, or no marched ray hits it, or little of it is in view."""
    rng = np.random.default_rng(200 + seed)
    labels, camera = random_labels(rng), random_camera(rng)
    put_wall(labels, camera)
    clusters = cluster_voxels(
        labels, EVERY_VOXEL.classes, EVERY_VOXEL.distance_table(), EVERY_VOXEL.min_voxels_table()
    )
    objects = extract_objects(labels, camera, EVERY_VOXEL)
    kept = {tuple(voxels) for voxels in objects.voxels.tolist()}
    world = (labels != 0) & (labels != IGNORE)
    marched, exact = march(world, camera), cast(world, camera)
    hidden = 0
    for voxels in clusters.split():
        own = np.zeros(labels.shape, dtype=bool)
        own[tuple(voxels.T)] = True
        pixels, depth = project_brute_force(voxels_to_metres(voxels + 0.5), camera)
        inside = (depth > 0) & ((pixels >= -0.5) & (pixels < np.array(SIZE[::-1]) - 0.5)).all(1)
        if tuple(voxels[0].tolist()) in kept:
            assert exact.on(own).any()
        elif inside.mean() >= MIN_SHARE_IN_VIEW:
            assert not marched.on(own).any()
            hidden += march(own, camera).found().any()
    assert hidden >= 1
    assert len(objects) >= 1


def test_visible_fraction_across_the_camera_plane() -> None:
    """A wall that passes the camera and is partly behind a pole."""
    labels = np.zeros((40, 14, 9), dtype=np.uint8)
    truck = labels[:, 11:13, 2:8]
    truck[...] = TRUCK
    labels[20:22, 9, :] = POLE
    eye = voxels_to_metres(np.array([12.5, 5.2, 4.4]))
    camera = look_at(eye, eye + np.array([1.0, 0.05, 0.02]), 0.1, 38)
    objects = extract_objects(labels, camera, EVERY_VOXEL)
    index = objects.classes.tolist().index(TRUCK)
    assert np.count_nonzero(objects.voxel_object == index) == truck.size
    _, depth = project_brute_force(voxels_to_metres(np.argwhere(labels == TRUCK) + 0.5), camera)
    assert depth.min() < -1
    assert depth.max() > 4
    assert 0.3 < objects.visible_fraction[index] < 0.9
    check_fractions(objects, brute_force_rays(labels, objects, camera))


@pytest.mark.parametrize("make_camera", [random_camera, camera_inside])
def test_boxes_bound_the_part_in_the_image(
    make_camera: Callable[[np.random.Generator], Camera],
) -> None:
    """Also for objects across the image's border or the camera plane."""
    size = np.array([SIZE[1], SIZE[0]])
    at_border = across = 0
    for seed in range(20):
        rng = np.random.default_rng(300 + seed)
        labels, camera = random_labels(rng), make_camera(rng)
        objects = extract_objects(labels, camera, EVERY_VOXEL)
        for index, box in enumerate(objects.boxes_cxcywh):
            voxels = objects.voxels[objects.voxel_object == index]
            corners = np.stack([voxels + c for c in itertools.product((0, 1), repeat=3)], axis=1)
            pixels, depth = project_brute_force(voxels_to_metres(corners).reshape(-1, 3), camera)
            pixels, depth = pixels.reshape(-1, 8, 2) + 0.5, depth.reshape(-1, 8)
            lower, upper = pixels.min(1), pixels.max(1)
            in_view = (depth > MIN_DEPTH).all(1) & (upper > 0).all(1) & (lower < size).all(1)
            lower, upper = lower[in_view].min(0), upper[in_view].max(0)
            low, high = lower.clip(0, size) / size, upper.clip(0, size) / size
            np.testing.assert_allclose(box, [*(low + high) / 2, *high - low], atol=1e-5)
            at_border += (lower < 0).any() or (upper > size).any()
            across += depth.min() < 0
    assert at_border >= 10
    assert (across >= 5) == (make_camera is camera_inside)


# real frames


@pytest.mark.slow
@pytest.mark.skipif(not REAL_ROOT.is_dir(), reason="no real frames here")
def test_real_frames_equal_marching() -> None:
    """Where marching finds another voxel, it missed one with less than one step of the ray."""
    pixels = found = another_class = 0
    passed_over, changes = [], []
    for frame in find_frames(REAL_ROOT, REAL_SEQUENCES):
        camera = read_camera(frame.calibration, image_size_of(frame.image))
        labels = read_labels(frame)
        world = (labels != 0) & (labels != IGNORE)
        exact, marched = cast(world, camera), march(world, camera)
        differs = (exact.voxels != marched.voxels).any(1)
        assert exact.found()[differs].all()
        chord = chords(exact.voxels[differs], camera, np.flatnonzero(differs))
        passed_over.append(chord * VOXEL_SIZE)
        pixels, found = pixels + differs.size, found + exact.found().sum()
        another_class += (seen_classes(labels, exact) != seen_classes(labels, marched)).sum()
        objects = extract_objects(labels, camera, ObjectSettings(ray_stride=1))
        owner = np.zeros(labels.shape, dtype=int)
        owner[tuple(objects.voxels.T)] = objects.voxel_object + 1
        seen = np.bincount(seen_classes(owner, marched), minlength=len(objects) + 1)[1:]
        alone = count_rays(owner, len(objects), camera)
        changes.append(np.abs(seen / alone - objects.visible_fraction))
    chord, change = np.concatenate(passed_over), np.concatenate(changes)
    print(
        f"\nanother first voxel: {len(chord):,} of {pixels:,} pixels "
        f"({len(chord) / pixels:.2%}; {len(chord) / found:.2%} of those that hit anything), "
        f"another class: {another_class / pixels:.2%}; passed over: {1000 * np.median(chord):.1f} "
        f"mm in the median, {1000 * chord.max():.2f} at most; visible fraction of {len(change)} "
        f"objects: changes by {np.median(change):.4f} in the median, {change.max():.4f} at most"
    )
    assert chord.min() > 0
    assert chord.max() < 0.01
    assert len(chord) / pixels < 0.02
    assert another_class / pixels < 0.0015
    assert len(change) > 150
    assert change.max() < 0.05


def seen_classes(labels: np.ndarray, hits: Hits) -> np.ndarray:
    """The value of ``labels`` at the end of each ray; 0 for rays that hit nothing."""
    return np.where(hits.found(), labels[tuple(hits.voxels.T)], 0)
