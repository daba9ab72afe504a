"""3D boxes between the grid frame and the camera frame."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from occdetr.geometry.boxes import (
    bounds_in_grid,
    box3d_corners,
    boxes3d_to_camera,
    boxes3d_to_grid,
)

#: KITTI's axes: camera x is -y of the grid frame, camera y is -z, camera z is x.
AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def turned_camera(yaw: float, pitch: float) -> np.ndarray:
    """lidar_to_camera of a camera turned to the left and downwards, in degrees."""
    (cy, sy), (cp, sp) = ((np.cos(a), np.sin(a)) for a in np.deg2rad([yaw, pitch]))
    about_z = np.array([[cy, sy, 0], [-sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    matrix = np.eye(4)
    matrix[:3, :3] = AXES @ about_y @ about_z
    matrix[:3, 3] = [0.1, -0.08, -0.27]
    return matrix


def random_boxes(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [rng.uniform([0, -25, -2], [50, 25, 4], (20, 3)), rng.uniform(0.2, 12, (20, 3))], axis=1
    )


@pytest.mark.parametrize("yaw", [0.0, 0.4, 30.0, -60.0, 90.0, 180.0])
@pytest.mark.parametrize("pitch", [0.0, 0.5, 20.0])
def test_the_way_to_the_camera_and_back_are_inverse(yaw: float, pitch: float) -> None:
    boxes, matrix = random_boxes(), turned_camera(yaw, pitch)
    there = boxes3d_to_camera(boxes, matrix)
    np.testing.assert_allclose(boxes3d_to_grid(there, matrix), boxes, atol=1e-9)
    np.testing.assert_allclose(
        boxes3d_to_camera(boxes3d_to_grid(boxes, matrix), matrix), boxes, atol=1e-9
    )
    # the same for tensors, with one camera per frame of a batch
    pair = torch.from_numpy(np.stack([boxes, boxes]))
    cameras = torch.from_numpy(np.stack([matrix, turned_camera(yaw + 90, pitch)]))
    moved = boxes3d_to_camera(pair, cameras)
    np.testing.assert_array_equal(moved[0].numpy(), there)
    torch.testing.assert_close(boxes3d_to_grid(moved, cameras), pair)


def test_sizes_follow_the_closest_axis() -> None:
    box = np.array([[10.0, 2.0, 1.0, 4.0, 1.8, 1.5]])  # length, width, height
    ahead, aside = (boxes3d_to_camera(box, turned_camera(yaw, 0.0))[0, 3:] for yaw in (10.0, 80.0))
    assert ahead.tolist() == [1.8, 1.5, 4.0]
    assert aside.tolist() == [4.0, 1.5, 1.8]


def test_bounds_hold_every_corner_and_grow_with_the_angle() -> None:
    boxes = torch.from_numpy(random_boxes())[None]
    grown = []
    for yaw in (0.0, 0.4, 30.0):
        matrix = torch.from_numpy(turned_camera(yaw, 0.0))[None]
        bounds = bounds_in_grid(boxes3d_to_camera(boxes, matrix), matrix)
        inverse = torch.linalg.inv(matrix)[:, None]
        corners = box3d_corners(boxes3d_to_camera(boxes, matrix))
        corners = corners @ inverse[..., :3, :3].mT + inverse[..., None, :3, 3]
        outside = (corners - bounds[..., None, :3]).abs() - bounds[..., None, 3:] / 2
        assert outside.max() < 1e-9
        grown.append((bounds[..., 3:] - boxes[..., 3:]).max().item())
    assert abs(grown[0]) < 1e-9
    assert 0 < grown[1] < 0.1
    assert grown[2] > 1
