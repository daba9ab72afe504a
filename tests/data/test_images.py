"""Images with their cameras."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from occdetr.data.images import (
    load_picture,
    read_picture,
    read_picture_camera,
    resize_picture,
)
from occdetr.errors import InputError
from occdetr.files import image_size_of, write_image
from occdetr.geometry.kitti import kitti_camera, write_calibration
from scene_factory import CAMERA, IMAGE_SIZE, one_line_error, project_brute_force

MODEL_SIZE = (64, 208)


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    write_calibration(tmp_path / "calib.txt", CAMERA)
    return tmp_path / "calib.txt"


def test_resized_images_fit_their_resized_cameras() -> None:
    """A bright blob at the projection of a point is found at its projection after resizing."""
    point = np.array([[12.0, -2.0, 0.5]])
    pixel = project_brute_force(point, CAMERA)[0][0]
    rows, columns = np.mgrid[0 : IMAGE_SIZE[0], 0 : IMAGE_SIZE[1]]
    distance = (columns - pixel[0]) ** 2 + (rows - pixel[1]) ** 2
    blob = (250 * np.exp(-distance / 50)).astype(np.uint8)
    image = np.repeat(blob[..., None], 3, axis=2)
    for size in (MODEL_SIZE, (60, 100), (240, 900)):
        resized, camera = resize_picture(image, CAMERA, size)
        expected = project_brute_force(point, camera)[0][0]
        weight = resized[..., 0].astype(float)
        rows, columns = np.mgrid[0 : size[0], 0 : size[1]]
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        np.testing.assert_allclose(found, expected, atol=0.05)


def write_picture(folder: Path, size: tuple[int, int]) -> Path:
    write_image(folder / "000005.png", np.zeros((*size, 3), dtype=np.uint8))
    return folder / "000005.png"


@pytest.mark.parametrize("size", [(60, 200), (240, 800), (120, 150), (120, 399), (1, 1)])
@pytest.mark.parametrize("read", [read_picture, read_picture_camera])
def test_images_of_another_size_than_their_calibration_are_reported(
    tmp_path: Path, calibration: Path, size: tuple[int, int], read: Callable
) -> None:
    with pytest.raises(InputError) as caught:
        read(write_picture(tmp_path, size), calibration)
    word = "too small" if size == (1, 1) else "calib.txt, which is for 400 x 120 pixels"
    assert one_line_error(caught, "000005.png: ", word)


@pytest.mark.parametrize("size", [(370, 1226), (376, 1241), (375, 1242)])
def test_kittis_images_belong_to_their_own_calibration(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    write_calibration(tmp_path / "calib.txt", kitti_camera())
    assert "size" not in (tmp_path / "calib.txt").read_text()
    path = write_picture(tmp_path, size)
    if size == (370, 1226):
        assert read_picture(path, tmp_path / "calib.txt")[1].image_size == size
        return
    with pytest.raises(InputError) as caught:
        read_picture(path, tmp_path / "calib.txt")
    assert one_line_error(caught, path, "wrong image size", "1226 x 370")


def test_without_a_size_the_principal_point_must_fit_and_a_warning_is_given_once(
    tmp_path: Path, calibration: Path
) -> None:
    lines = calibration.read_text().splitlines()
    calibration.write_text("\n".join(line for line in lines if not line.startswith("size")))
    with pytest.raises(InputError) as caught:
        read_picture(write_picture(tmp_path, (60, 200)), calibration)
    assert one_line_error(caught, "000005.png: wrong image size", "(197, 58)")
    path = write_picture(tmp_path, (110, 380))
    with pytest.warns(UserWarning, match=r"calib\.txt: the size of its images is not known"):
        read_picture(path, calibration)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_picture(path, calibration)


def test_loaded_images_have_the_size_asked_for(tmp_path: Path, calibration: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (*IMAGE_SIZE, 3), dtype=np.uint8)
    write_image(tmp_path / "street.png", image)
    whole, camera = read_picture(tmp_path / "street.png", calibration)
    np.testing.assert_array_equal(whole, image)
    assert camera.image_size == IMAGE_SIZE
    small, small_camera = load_picture(tmp_path / "street.png", calibration, MODEL_SIZE)
    assert small.shape == (*MODEL_SIZE, 3)
    assert small_camera.image_size == MODEL_SIZE


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_the_size_of_an_image_file(tmp_path: Path, ending: str) -> None:
    write_image(tmp_path / f"street{ending}", np.zeros((*IMAGE_SIZE, 3), dtype=np.uint8))
    assert image_size_of(tmp_path / f"street{ending}") == IMAGE_SIZE
