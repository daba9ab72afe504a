"""Images with their cameras: read, resized, checked."""

from __future__ import annotations

import functools
import warnings
from pathlib import Path

import cv2
from jaxtyping import UInt8
from numpy.typing import NDArray

from occdetr.errors import InputError
from occdetr.files import image_size_of, read_image
from occdetr.geometry.camera import MIN_IMAGE_SIDE, Camera, resize_camera
from occdetr.geometry.kitti import read_calibration

# Largest distance of the principal point from the image's centre, as a share of width and height,
# of images whose calibration does not say their size.
MAX_OFF_CENTER = (0.25, 0.35)


def read_picture(
    image_path: Path, calibration_path: Path
) -> tuple[UInt8[NDArray, "height width 3"], Camera]:
    """An RGB image file and the camera that took it.

    Raises ``InputError`` if a file is missing or broken, or if they do not belong together.
    """
    image = read_image(image_path)
    return image, fitting_camera(image_path, (image.shape[0], image.shape[1]), calibration_path)


def read_picture_camera(image_path: Path, calibration_path: Path) -> Camera:
    """The camera of ``read_picture``, mostly without decoding the image."""
    return fitting_camera(image_path, image_size_of(image_path), calibration_path)


def load_picture(
    image_path: Path, calibration_path: Path, image_size: tuple[int, int]
) -> tuple[UInt8[NDArray, "height width 3"], Camera]:
    """``read_picture``, resized to ``image_size`` (height, width)."""
    return resize_picture(*read_picture(image_path, calibration_path), image_size)


def resize_picture(
    image: UInt8[NDArray, "height width 3"], camera: Camera, image_size: tuple[int, int]
) -> tuple[UInt8[NDArray, "new_height new_width 3"], Camera]:
    """An image and its camera, both resized to ``image_size`` (height, width)."""
    if image_size != camera.image_size:
        smaller = image_size[0] <= image.shape[0] and image_size[1] <= image.shape[1]
        method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        image = cv2.resize(image, (image_size[1], image_size[0]), interpolation=method)
    return image, resize_camera(camera, image_size)


def fitting_camera(image_path: Path, image_size: tuple[int, int], calibration_path: Path) -> Camera:
    """The calibration's camera for an image of ``image_size`` (height, width).

    Raises ``InputError`` if the calibration cannot be used or belongs to another size. Where that
    is not known, it warns, and the principal point must not be far from the image's centre.
    """
    height, width = image_size
    if min(image_size) < MIN_IMAGE_SIDE:
        raise InputError(
            f"{image_path}: image is too small: {width} x {height} pixels: "
            f"give {MIN_IMAGE_SIDE} or more in both directions"
        )
    calibration = read_calibration(calibration_path)
    camera = Camera(calibration.projection, calibration.lidar_to_camera, image_size)
    u, v = camera.projection[:2, 2]
    off_center = abs(u - width / 2) / width, abs(v - height / 2) / height
    if calibration.image_size is None:
        fits = off_center[0] <= MAX_OFF_CENTER[0] and off_center[1] <= MAX_OFF_CENTER[1]
        known = f"whose P2 has its principal point at ({u:.0f}, {v:.0f})"
    else:
        fits = calibration.image_size == image_size
        known = "which is for {1} x {0} pixels".format(*calibration.image_size)
    if not fits:
        raise InputError(
            f"{image_path}: wrong image size: {width} x {height} pixels do not belong to "
            f"{calibration_path}, {known}: "
            "use the image in its original size, or a calib.txt for this size"
        )
    if calibration.image_size is None:
        _warn_of_unknown_size(calibration_path)
    return camera


@functools.cache  # once for each file
def _warn_of_unknown_size(calibration_path: Path) -> None:
    warnings.warn(
        f"{calibration_path}: the size of its images is not known, so a resized or cropped image "
        "cannot be noticed: add a line such as size: 1226 370 (width and height)",
        stacklevel=4,
    )
