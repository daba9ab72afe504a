"""Object labels: settings, visibility, boxes."""

from __future__ import annotations

import dataclasses
import itertools
import time

import numpy as np
import pytest
import torch

from occdetr.classes import CLASS_NAMES, IGNORE
from occdetr.data import objects as objects_module
from occdetr.data.frames import find_frames
from occdetr.data.objects import (
    ObjectSettings,
    SceneObjects,
    extract_objects,
)
from occdetr.data.semantickitti import read_labels
from occdetr.errors import InputError
from occdetr.files import image_size_of
from occdetr.geometry.boxes import bounds_in_grid, boxes3d_to_camera, boxes3d_to_grid
from occdetr.geometry.camera import Camera
from occdetr.geometry.kitti import read_camera
from occdetr.geometry.raycast import camera_rays, cast_rays
from occdetr.geometry.voxels import metres_to_voxels, voxels_to_metres
from scene_factory import (
    CAMERA,
    IMAGE_SIZE,
    REAL_ROOT,
    REAL_SEQUENCES,
    empty_grid,
    project_brute_force,
    put_box,
    street,
)

CAR, POLE = CLASS_NAMES.index("car"), CLASS_NAMES.index("pole")
EVERY_PIXEL = ObjectSettings(ray_stride=1)


def extract(labels: np.ndarray, settings: ObjectSettings = EVERY_PIXEL) -> SceneObjects:
    return extract_objects(labels, CAMERA, settings)


# settings


def test_distance_and_minimum_size_are_set_by_class() -> None:
    labels = empty_grid()
    for x in (10.0, 11.0):  # a gap of 0.8 m between the centres of the nearest voxels
        put_box(labels, "car", (x, 3.0, 0.0), (0.4, 0.4, 2.0))
        put_box(labels, "pole", (x, -3.0, 0.0), (0.4, 0.4, 2.0))
    assert sorted(extract(labels).classes) == [CAR, CAR, POLE, POLE]  # both 0.6 m by default
    wide = ObjectSettings(ray_stride=1, distance={"default": 1.0})
    assert extract(labels, wide).classes.tolist() == [POLE, CAR]
    mixed = ObjectSettings(ray_stride=1, distance={"default": 1.0, "car": 0.6})
    assert sorted(extract(labels, mixed).classes) == [CAR, CAR, POLE]
    for least, cars in ((40, 2), (41, 0)):
        settings = ObjectSettings(ray_stride=1, min_voxels={"car": least})
        assert np.count_nonzero(extract(labels, settings).classes == CAR) == cars


@pytest.mark.parametrize(("in_view", "objects"), [(1, 0), (3, 1)])
def test_slivers_at_the_border_are_no_objects(in_view: int, objects: int) -> None:
    """``in_view`` of 20 rows of voxels across the image's left border are in the image."""
    labels, x = empty_grid(), 10.1
    centers = voxels_to_metres(np.array([[60, y + 0.5, 10.5] for y in range(256)]))
    centers[:, 0] = x
    pixels, _ = project_brute_force(centers, CAMERA)
    last = np.flatnonzero(pixels[:, 0] >= 0).max()  # the row farthest to the left in the image
    labels[50, last - in_view + 1 : last - in_view + 21, 10:14] = CAR
    assert len(extract(labels)) == objects


@pytest.mark.parametrize(
    ("keywords", "word"),
    [
        ({"classes": (0,)}, "classes"),
        ({"classes": (20,)}, "classes"),
        ({"distance": {"lorry": 1.0}}, "lorry"),
        ({"min_voxels": {"lorry": 1}}, "lorry"),
        ({"distance": {"car": 0.2}}, "distance"),
        ({"ray_stride": 0}, "ray_stride"),
    ],
)
def test_invalid_settings_are_reported(keywords: dict, word: str) -> None:
    with pytest.raises(InputError, match=word) as error:
        ObjectSettings(**keywords)
    assert "\n" not in str(error.value)


# visibility


def test_hidden_objects_are_dropped_and_partly_hidden_ones_complete() -> None:
    alone = empty_grid()
    car = put_box(alone, "car", (20.0, 0.0, 0.0), (4.0, 2.0, 1.6))
    full = extract(alone)
    assert full.visible_fraction.tolist() == [1.0]

    hidden = alone.copy()
    put_box(hidden, "building", (10.0, 0.0, 0.0), (0.2, 8.0, 4.0))
    assert len(extract(hidden)) == 0

    partly = alone.copy()
    put_box(partly, "building", (17.0, 0.8, 0.0), (0.2, 1.6, 4.0))  # covers the left of it
    objects = extract(partly)
    assert 0.3 < objects.visible_fraction[0] < 0.7
    assert np.array_equal(objects.boxes_cxcywh, full.boxes_cxcywh)
    assert np.array_equal(objects.boxes3d_grid, full.boxes3d_grid)
    assert np.array_equal(np.unique(objects.voxels, axis=0), car)


def test_unknown_voxels_do_not_hide_objects() -> None:
    labels = street()
    expected = extract(labels)
    labels[30:40][labels[30:40] == 0] = IGNORE
    objects = extract(labels)
    assert np.array_equal(objects.visible_fraction, expected.visible_fraction)


def test_visible_fraction_equals_the_ratio_of_ray_counts() -> None:
    labels = street()
    put_box(labels, "vegetation", (8.0, 2.0, -1.2), (1.0, 2.0, 0.8))
    objects = extract(labels)
    for index, class_id in enumerate(objects.classes):
        seen = _pixels_that_hit(labels > 0, labels == class_id)
        alone = _pixels_that_hit(labels == class_id, labels == class_id)
        assert 0 < seen <= alone
        assert objects.visible_fraction[index] == pytest.approx(seen / alone, abs=1e-6)
    assert objects.visible_fraction.min() < 1


def _pixels_that_hit(occupied: np.ndarray, wanted: np.ndarray) -> int:
    origins, directions = camera_rays(CAMERA)
    hits, _, _ = cast_rays(occupied, metres_to_voxels(origins), directions)
    hits = hits[hits[:, 0] >= 0]
    return int(wanted[tuple(hits.T)].sum())


def test_min_visible_pixels() -> None:
    labels = street()
    few = ObjectSettings(ray_stride=1, min_visible_pixels=600)
    assert sorted(extract(labels).classes) == [CAR, POLE]
    assert extract(labels, few).classes.tolist() == [CAR]


# boxes


def test_2d_box_bounds_the_projected_voxels() -> None:
    labels = empty_grid()
    voxels = put_box(labels, "car", (15.0, 2.0, -0.6), (4.0, 1.8, 1.6))
    corners = np.concatenate([voxels + c for c in itertools.product((0, 1), repeat=3)])
    pixels, _ = project_brute_force(voxels_to_metres(corners), CAMERA)
    lower, upper = pixels.min(0) + 0.5, pixels.max(0) + 0.5
    size = np.array([IMAGE_SIZE[1], IMAGE_SIZE[0]])
    expected = np.concatenate([(lower + upper) / 2 / size, (upper - lower) / size])
    np.testing.assert_allclose(extract(labels).boxes_cxcywh[0], expected, atol=1e-5)


def test_2d_boxes_are_clipped_to_the_image() -> None:
    labels = empty_grid()
    put_box(labels, "car", (10.0, 8.6, -0.8), (4.0, 3.0, 1.6))
    box = extract(labels).boxes_cxcywh[0]
    assert box[0] - box[2] / 2 == pytest.approx(0, abs=1e-6)
    assert 0.02 < box[2] < 0.3


def test_object_across_the_camera_plane() -> None:
    """The box bounds the part in front of the plane; the object keeps all its voxels."""
    ahead = CAMERA.lidar_to_camera.copy()
    ahead[2, 3] -= 10.0  # the camera is 10 m further ahead
    camera = dataclasses.replace(CAMERA, lidar_to_camera=ahead)
    labels = empty_grid()
    voxels = put_box(labels, "truck", (10.5, 3.0, 0.0), (19.0, 1.0, 2.0))
    objects = extract_objects(labels, camera, EVERY_PIXEL)
    assert len(objects.voxels) == len(voxels)
    corners = np.stack([voxels + c for c in itertools.product((0, 1), repeat=3)], axis=1)
    pixels, depth = project_brute_force(voxels_to_metres(corners).reshape(-1, 3), camera)
    pixels, depth = pixels.reshape(-1, 8, 2) + 0.5, depth.reshape(-1, 8)
    size = np.array([IMAGE_SIZE[1], IMAGE_SIZE[0]])
    lower, upper = pixels.min(1), pixels.max(1)
    in_view = (depth > 0.1).all(1) & (upper > 0).all(1) & (lower < size).all(1)
    low = lower[in_view].min(0).clip(0, size) / size
    high = upper[in_view].max(0).clip(0, size) / size
    expected = np.concatenate([(low + high) / 2, high - low])
    np.testing.assert_allclose(objects.boxes_cxcywh[0], expected, atol=1e-5)
    assert high[0] < 0.5  # all of it is to the left


@pytest.mark.parametrize(
    ("center", "size"),
    [
        ((0.1, 0.0, 0.0), (0.2, 10.0, 4.0)),  # behind the camera
        ((2.0, 15.0, 0.0), (4.0, 2.0, 2.0)),  # far to the side
        ((5.0, 0.0, 0.0), (0.2, 30.0, 12.0)),  # bigger than the image
    ],
)
def test_clusters_out_of_view_or_as_large_as_the_image_are_dropped(
    center: tuple, size: tuple
) -> None:
    labels = empty_grid()
    put_box(labels, "truck", center, size)
    assert np.count_nonzero(labels) > 100
    assert len(extract(labels)) == 0


def test_boxes3d_and_voxels() -> None:
    objects = extract(street())
    index = objects.classes.tolist().index(CAR)
    np.testing.assert_allclose(
        objects.boxes3d_grid[index], [14.0, 3.0, -0.8, 4.0, 1.8, 1.6], atol=0.21
    )
    voxels = objects.voxels[objects.voxel_object == index]
    assert (street()[tuple(voxels.T)] == CAR).all()
    assert len(voxels) == np.count_nonzero(street() == CAR)
    lower, upper = voxels_to_metres(voxels.min(0)), voxels_to_metres(voxels.max(0) + 1)
    np.testing.assert_allclose(objects.boxes3d_grid[index, :3], (lower + upper) / 2, atol=1e-5)
    np.testing.assert_allclose(objects.boxes3d_grid[index, 3:], upper - lower, atol=1e-5)


def test_camera_boxes_transform_back_to_grid_boxes() -> None:
    objects = extract(street())
    lidar_to_camera = torch.from_numpy(CAMERA.lidar_to_camera)[None]
    boxes = torch.from_numpy(objects.boxes3d_camera).double()[None]
    back = boxes3d_to_grid(boxes, lidar_to_camera)[0].numpy()
    np.testing.assert_allclose(back, objects.boxes3d_grid, atol=1e-5)
    bounds = bounds_in_grid(boxes, lidar_to_camera)[0].numpy()
    np.testing.assert_allclose(bounds[:, :3], objects.boxes3d_grid[:, :3], atol=2e-3)
    assert (bounds[:, 3:] >= objects.boxes3d_grid[:, 3:] - 1e-5).all()
    np.testing.assert_allclose(bounds[:, 3:], objects.boxes3d_grid[:, 3:], atol=0.06)


def test_camera_size_is_width_height_length() -> None:
    box = boxes3d_to_camera(np.array([[10.0, 2.0, 1.0, 4.0, 1.8, 1.5]]), CAMERA.lidar_to_camera)
    np.testing.assert_allclose(box[0, 3:], [1.8, 1.5, 4.0], atol=1e-6)
    np.testing.assert_allclose(box[0, :3], [-2.0, -1.0, 9.7], atol=0.2)


# partitions


def test_no_rays_are_cast_without_object_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects_module, "count_rays", lambda *args: pytest.fail("cast rays"))
    objects = extract(street(), ObjectSettings(classes=()))
    assert len(objects) == 0
    assert objects.voxels.shape == (0, 3)


def test_every_class_can_be_an_object() -> None:
    objects = extract(street(), ObjectSettings(classes=tuple(range(1, 20))))
    assert sorted(CLASS_NAMES[index] for index in objects.classes) == ["car", "pole", "road"]


def test_an_empty_street_has_no_objects() -> None:
    assert len(extract(empty_grid())) == 0


# real frames


@pytest.mark.skipif(not REAL_ROOT.is_dir(), reason="no real frames here")
def test_real_frames() -> None:
    frames = find_frames(REAL_ROOT, REAL_SEQUENCES)
    settings, seconds, total = ObjectSettings(), [], 0
    for frame in frames:
        camera = read_camera(frame.calibration, image_size_of(frame.image))
        labels = read_labels(frame)
        began = time.process_time()
        objects = extract_objects(labels, camera, settings)
        seconds.append(time.process_time() - began)
        total += len(objects)
        assert (labels[tuple(objects.voxels.T)] == objects.classes[objects.voxel_object]).all()
        assert (objects.visible_fraction > 0).all()
        assert (objects.visible_fraction <= 1).all()
        assert (objects.boxes3d_camera[:, 2] > 0).all()
        _check_centers_are_in_boxes(objects, camera)
    assert 150 < total < 230
    assert np.median(seconds) < 0.38


def _check_centers_are_in_boxes(objects: SceneObjects, camera: Camera) -> None:
    """A 2D box contains the projected centres of its object's voxels that are in the image."""
    scale = np.array(camera.image_size[::-1])
    pixels, depth = project_brute_force(voxels_to_metres(objects.voxels + 0.5), camera)
    points = (pixels + 0.5) / scale
    in_view = (depth > 1) & (points > 0).all(1) & (points < 1).all(1)
    offset = np.abs(points - objects.boxes_cxcywh[objects.voxel_object, :2])
    inside = (offset <= objects.boxes_cxcywh[objects.voxel_object, 2:] / 2 + 1e-5).all(1)
    assert inside[in_view].all()
    assert in_view.sum() > 10
