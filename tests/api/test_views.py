"""Views of images of other cameras: what they show, and how their predictions come back."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from occdetr.api.camera import Camera
from occdetr.api.views import (
    View,
    boxes_in_grid,
    boxes_in_image,
    make_views,
    merge_grids,
    voxel_sources,
)
from occdetr.classes import IGNORE
from occdetr.errors import InputError
from occdetr.geometry.boxes import boxes3d_to_camera
from occdetr.geometry.camera import project_points, transform_points
from occdetr.geometry.kitti import kitti_camera, write_calibration
from occdetr.geometry.voxels import GRID_SHAPE, points_to_indices, voxel_centers

SIZE = (96, 312)
FISHEYE = (0.05, -0.02, 0.004, -0.0005)
RADTAN = (-0.28, 0.07, 0.0002, 0.00002, 0.0)


def usual(width: int, height: int, fov: float) -> NDArray[np.float64]:
    focal = width / 2 / math.tan(math.radians(fov) / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


CAMERAS = {
    "a photo": (Camera.from_fov(70, height=1.5), (480, 640)),
    "pitched and rolled": (Camera.from_fov(75, height=2.2, pitch=-12, roll=7), (540, 960)),
    "a phone's portrait": (Camera.from_fov(50, height=1.6, pitch=3), (800, 600)),
    "distorted": (
        Camera.from_intrinsics(usual(960, 600, 80), (600, 960), RADTAN, pitch=-5),
        (600, 960),
    ),
    "fish-eye": (
        Camera.from_intrinsics(
            [[330.0, 0, 479.5], [0, 330.0, 359.5], [0, 0, 1]], (720, 960), FISHEYE, fisheye=True
        ),
        (720, 960),
    ),
}


def colors(points: NDArray[np.float64], camera_center: NDArray[np.float64]) -> NDArray[np.float64]:
    """A world that is painted by direction: azimuth and elevation of each point in RGB."""
    x, y, z = np.moveaxis(points - camera_center, -1, 0)
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    return np.stack([127 + 60 * azimuth, 127 + 90 * elevation, 127 + 40 * np.sin(6 * azimuth)], -1)


def photograph(camera: Camera, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The painted world through OpenCV's own undistortion of every pixel."""
    own = camera.for_image(size)
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float64)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    k = np.array(own.distortion or (0.0,) * 4)
    assert own.projection is not None
    matrix = own.projection[:, :3]
    undistort = cv2.fisheye.undistortPoints if own.fisheye else cv2.undistortPoints
    plane = undistort(pixels, matrix, k).reshape(*size, 2)
    rays = np.concatenate([plane, np.ones((*size, 1))], -1)
    ahead = rays @ own.grid_to_camera[:3, :3]
    return colors(ahead, np.zeros(3)).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_view_shows_what_the_trainings_camera_would_see(name: str) -> None:
    camera, size = CAMERAS[name]
    views = make_views(photograph(camera, size), camera, SIZE)
    for view in views:
        assert view.source is not None
        assert view.seen is not None
        assert view.seen.mean() > 0.5
        assert view.camera.image_size == SIZE
        v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
        rays = np.stack([u, v, np.ones_like(u)], -1)
        rays = rays @ np.linalg.inv(view.camera.projection[:, :3]).T
        ahead = rays @ view.camera.lidar_to_camera[:3, :3] @ view.to_vehicle[:3, :3].T
        expected = colors(ahead, np.zeros(3))
        error = np.abs(view.image.astype(float) - expected).max(-1)[view.seen]
        assert np.quantile(error, 0.98) < 4
    number = len(views)
    assert number == (3 if name == "fish-eye" else 1)


def test_an_image_of_the_trainings_camera_is_only_resized(tmp_path) -> None:
    size = (185, 613)
    write_calibration(tmp_path / "calib.txt", kitti_camera(size))
    camera = Camera.from_kitti(tmp_path / "calib.txt")
    image = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    (view,) = make_views(image, camera, SIZE)
    expected = cv2.resize(image, (SIZE[1], SIZE[0]), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(view.image, expected)
    assert view.seen is None
    grid = np.random.default_rng(1).integers(0, 20, GRID_SHAPE, dtype=np.uint8)
    assert merge_grids(voxel_sources([view], camera), [grid], IGNORE) is grid


def seen_by(camera: Camera, size: tuple[int, int], points: NDArray) -> NDArray[np.bool_]:
    """Points of the grid frame that are in the photo, a little inside of its border."""
    rays = transform_points(points, camera.centered().grid_to_camera)
    pixels, valid = camera.project(rays)
    margin = 0.02 * size[1]
    inside = (pixels > margin) & (pixels < np.array([size[1], size[0]]) - margin)
    return valid & inside.all(-1) & (rays[..., 2] > 1)


@pytest.mark.parametrize("name", CAMERAS)
def test_grids_of_views_come_back_into_the_grid_of_the_vehicle(name: str) -> None:
    """A wall across the street and one beside it, in a perfect network's grids of every view."""
    camera, size = CAMERAS[name]
    views = make_views(np.zeros((*size, 3), np.uint8), camera, SIZE)
    everywhere = voxel_centers(np.argwhere(np.ones(GRID_SHAPE, bool)))

    def walls(points: NDArray) -> NDArray[np.uint8]:
        x, y, _ = points.T
        across, beside = (x > 20) & (x < 23), (y > 4) & (y < 7)
        return np.where(across, 13, np.where(beside, 15, 9)).astype(np.uint8)

    grids = [
        walls(transform_points(everywhere, view.to_vehicle)).reshape(GRID_SHAPE) for view in views
    ]
    merged = merge_grids(voxel_sources(views, camera.for_image(size)), grids, IGNORE).reshape(-1)
    known = merged != IGNORE
    assert (merged[known] == walls(everywhere)[known]).mean() > 0.985  # but for a voxel at borders
    own = camera.for_image(size)
    assert known[seen_by(own, size, everywhere)].mean() > 0.99  # also below and above the views
    behind = ~seen_by(own, size, everywhere) & (everywhere[:, 0] > 5)
    assert name == "fish-eye" or known[behind].mean() < 0.12


@pytest.mark.parametrize("name", CAMERAS)
def test_boxes_come_back_into_pixels_and_into_the_grid_frame(name: str) -> None:
    camera, size = CAMERAS[name]
    own = camera.for_image(size)
    box = np.array([18.0, 2.0, -0.8, 1.0, 1.0, 1.2])
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    corners = box[:3] + signs * box[3:] / 2
    in_photo, valid = own.project(transform_points(corners, own.centered().grid_to_camera))
    assert valid.all()
    view: View = make_views(np.zeros((*size, 3), np.uint8), camera, SIZE)[0]
    local = transform_points(corners, np.linalg.inv(view.to_vehicle))
    pixels, _ = project_points(
        transform_points(local, view.camera.lidar_to_camera), view.camera.projection
    )
    flat = np.concatenate([pixels.min(0), pixels.max(0)])[None]
    found = boxes_in_image(view, flat, size)[0]
    expected = np.concatenate([in_photo.min(0), in_photo.max(0)])
    assert np.abs(found - expected).max() < 0.01 * size[1]
    assert boxes_in_image(view, np.zeros((0, 4)), size).shape == (0, 4)
    center = transform_points(box[None, :3], np.linalg.inv(view.to_vehicle))
    in_camera = boxes3d_to_camera(
        np.concatenate([center, box[None, 3:]], 1), view.camera.lidar_to_camera
    )
    back = boxes_in_grid(view, in_camera)[0]
    np.testing.assert_allclose(back[:3], box[:3], atol=1e-6)
    assert (back[3:] >= box[3:] - 1e-6).all()
    assert (back[3:] < box[3:] * 1.5).all()
    assert points_to_indices(back[:3]).tolist() == points_to_indices(box[:3]).tolist()


def test_a_box_beyond_the_lens_is_not_drawn_to_the_middle() -> None:
    """Barrel distortion that turns back at 39 degrees: the view is wider than that."""
    matrix = [[650.0, 0, 319.5], [0, 650.0, 239.5], [0, 0, 1]]
    camera = Camera.from_intrinsics(matrix, (480, 640), (-0.5, 0, 0, 0))
    (view,) = make_views(np.zeros((480, 640, 3), np.uint8), camera, SIZE)
    assert view.seen is not None
    assert not view.seen[48, -2]
    box = np.array([[SIZE[1] - 40.0, 40.0, SIZE[1] - 1.0, 60.0]])
    left = boxes_in_image(view, box, (480, 640))[0, 0]
    assert left > 500
    (beyond,) = boxes_in_image(view, box + np.array([36, 0, 0, 0]), (480, 640))
    assert beyond[2] - beyond[0] < 20


@pytest.mark.parametrize(("fov", "size", "pitch"), [(5, (480, 640), 2.4), (20, (200, 1920), 0)])
def test_a_narrow_image_shows_part_of_a_view(fov, size, pitch) -> None:
    camera = Camera.from_fov(fov, pitch=pitch)
    (view,) = make_views(np.zeros((*size, 3), np.uint8), camera, SIZE)
    assert view.seen is not None
    assert 0 < view.seen.mean() < 0.5


def test_a_camera_that_looks_down_is_refused() -> None:
    with pytest.raises(InputError, match="looks up or down by more than 60 degrees"):
        make_views(np.zeros((480, 640, 3), np.uint8), Camera.from_fov(70, pitch=-75), SIZE)
    with pytest.raises(InputError, match="nothing at the height of the horizon"):
        make_views(np.zeros((480, 640, 3), np.uint8), Camera.from_fov(30, pitch=-50), SIZE)


def test_a_side_camera_fills_the_side_of_the_grid() -> None:
    camera, size = Camera.from_fov(70, yaw=45), (480, 640)
    views = make_views(np.zeros((*size, 3), np.uint8), camera, SIZE)
    full = np.full(GRID_SHAPE, 9, np.uint8)
    merged = merge_grids(voxel_sources(views, camera.for_image(size)), [full] * len(views), IGNORE)
    known = (merged != IGNORE).any(2)
    assert known[60, 128 + 60]  # to the left, ahead
    assert not known[60, 128 - 60]
    assert not known[100, 128]


def test_ground_below_the_views_is_given_by_the_view_in_its_direction() -> None:
    camera, size = Camera.from_fov(120, height=4.0, pitch=-15), (1080, 1920)
    views = make_views(np.zeros((*size, 3), np.uint8), camera, SIZE)
    assert len(views) == 3
    grids = [np.full(GRID_SHAPE, 1 + number, np.uint8) for number in range(3)]
    sources = voxel_sources(views, camera.for_image(size))
    merged = merge_grids(sources, grids, IGNORE)
    given = {}
    for name, point in {"left": (5.0, 5.0), "ahead": (7.0, 0.0), "right": (5.0, -5.0)}.items():
        place = np.array([[*point, -1.65]])
        (index,) = points_to_indices(place)
        given[name] = int(merged[tuple(index)])
    left = [np.degrees(np.arctan2(v.to_vehicle[1, 0], v.to_vehicle[0, 0])) for v in views]
    assert given["ahead"] == 1
    assert given["left"] == 1 + int(np.argmax(left))
    assert given["right"] == 1 + int(np.argmin(left))
