"""Resizing, cropping and flipping a camera agree with projecting points."""

import numpy as np
import pytest
import torch

from occdetr.geometry.camera import (
    crop_camera,
    denormalize_pixels,
    flip_camera,
    invert_transform,
    normalize_pixels,
    project_points,
    resize_camera,
    transform_points,
    unproject,
)
from scene_factory import CAMERA, IMAGE_SIZE, project_brute_force

POINTS = np.random.default_rng(1).uniform([1, -20, -2], [50, 20, 4], (500, 3))


@pytest.mark.parametrize("size", [(60, 200), (240, 800), (97, 333), IMAGE_SIZE])
def test_a_resized_camera_keeps_normalised_image_coordinates(size):
    resized = resize_camera(CAMERA, size)
    before, depth = project_brute_force(POINTS, CAMERA)
    after, new_depth = project_brute_force(POINTS, resized)
    assert resized.image_size == size
    np.testing.assert_allclose(
        normalize_pixels(after, size), normalize_pixels(before, IMAGE_SIZE), atol=1e-9
    )
    np.testing.assert_allclose(new_depth, depth)


@pytest.mark.parametrize(("left", "top"), [(0, 0), (30, 10), (399, 119)])
def test_a_cropped_camera_shifts_pixels(left, top):
    cropped = crop_camera(CAMERA, left, top, (1, 1))
    before, _ = project_brute_force(POINTS, CAMERA)
    after, _ = project_brute_force(POINTS, cropped)
    assert cropped.image_size == (1, 1)
    np.testing.assert_allclose(after, before - [left, top], atol=1e-8)


def test_a_flipped_camera_sees_mirrored_points_at_mirrored_pixels() -> None:
    mirrored = flip_camera(CAMERA)
    points = np.random.default_rng(1).uniform([1, -20, -2], [50, 20, 4], (500, 3))
    pixels, depth = project_brute_force(points, CAMERA)
    flipped, flipped_depth = project_brute_force(points * [1, -1, 1], mirrored)
    np.testing.assert_allclose(flipped[:, 0], IMAGE_SIZE[1] - 1 - pixels[:, 0], atol=1e-8)
    np.testing.assert_allclose(flipped[:, 1], pixels[:, 1], atol=1e-8)
    np.testing.assert_allclose(flipped_depth, depth, atol=1e-10)
    assert mirrored.projection[0, 0] > 0
    assert np.linalg.det(mirrored.lidar_to_camera[:3, :3]) == pytest.approx(1, abs=1e-3)


def test_flipping_twice_changes_nothing():
    twice = flip_camera(flip_camera(CAMERA))
    np.testing.assert_allclose(twice.projection, CAMERA.projection, atol=1e-10)
    np.testing.assert_array_equal(twice.lidar_to_camera, CAMERA.lidar_to_camera)


def test_resizing_there_and_back_changes_nothing():
    back = resize_camera(resize_camera(CAMERA, (97, 333)), IMAGE_SIZE)
    np.testing.assert_allclose(back.projection, CAMERA.projection, atol=1e-10)


def test_cropping_and_flipping_commute() -> None:
    """Cropping a flipped camera at the mirrored place equals flipping the cropped camera."""
    cropped = flip_camera(crop_camera(CAMERA, 30, 10, (90, 200)))
    flipped = crop_camera(flip_camera(CAMERA), IMAGE_SIZE[1] - 230, 10, (90, 200))
    assert cropped.image_size == flipped.image_size == (90, 200)
    np.testing.assert_allclose(cropped.projection, flipped.projection, atol=1e-9)
    np.testing.assert_array_equal(cropped.lidar_to_camera, flipped.lidar_to_camera)


def test_unproject_inverts_projection():
    points = transform_points(POINTS, CAMERA.lidar_to_camera)
    pixels, _ = project_points(points, CAMERA.projection)
    back = unproject(pixels, points[:, 2], CAMERA.projection)
    np.testing.assert_allclose(back, points, atol=1e-9)


def test_normalised_coordinates_span_the_image():
    corners = np.array([[-0.5, -0.5], [IMAGE_SIZE[1] - 0.5, IMAGE_SIZE[0] - 0.5]])
    np.testing.assert_allclose(normalize_pixels(corners, IMAGE_SIZE), [[0, 0], [1, 1]])
    np.testing.assert_allclose(
        denormalize_pixels(normalize_pixels(corners, IMAGE_SIZE), IMAGE_SIZE), corners
    )


def test_inverse_of_transforms_equals_linalg() -> None:
    """Of any affine transform, since calibrations are rounded rotations."""
    generator = torch.Generator().manual_seed(0)
    transform = torch.eye(4, dtype=torch.float64) + torch.rand(2, 3, 4, 4, generator=generator)
    transform[..., 3, :] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    assert torch.allclose(invert_transform(transform), torch.linalg.inv(transform), rtol=1e-9)
