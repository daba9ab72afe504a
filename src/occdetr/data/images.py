"""Images with their cameras: read, resized, checked; normalisation and its inverse."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from numpy.typing import NDArray
from torch import Tensor

from occdetr.errors import InputError
from occdetr.files import read_image
from occdetr.geometry.camera import Camera, resize_camera
from occdetr.geometry.kitti import read_camera

#: Mean and standard deviation of RGB values from 0 to 1 (ImageNet).
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

# Largest distance of the principal point from the image's centre, as a share of width and height.
MAX_OFF_CENTER = (0.25, 0.35)


def normalize_image(
    image: UInt8[NDArray, "height width 3"],
) -> Float32[NDArray, "3 height width"]:
    """An RGB image as the network takes it: (value / 255 - mean) / deviation for each channel."""
    scale = 1 / (255 * np.array(IMAGENET_STD, dtype=np.float32))
    shift = np.array(IMAGENET_MEAN, dtype=np.float32) / np.array(IMAGENET_STD, dtype=np.float32)
    channels = np.ascontiguousarray(image.transpose(2, 0, 1)).astype(np.float32)
    channels *= scale[:, None, None]
    channels -= shift[:, None, None]
    return channels


def denormalize_image(image: Float[Tensor, "3 height width"]) -> UInt8[NDArray, "height width 3"]:
    """The RGB image that ``normalize_image`` was given."""
    mean, std = image.new_tensor(IMAGENET_MEAN), image.new_tensor(IMAGENET_STD)
    pixels = (image * std[:, None, None] + mean[:, None, None]).clamp(0, 1) * 255
    return pixels.round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()


def read_picture(
    image_path: Path, calibration_path: Path
) -> tuple[UInt8[NDArray, "height width 3"], Camera]:
    """An RGB image file and the camera that took it.

    Raises ``InputError`` if a file is missing or broken, or if they do not belong together.
    """
    image = read_image(image_path)
    camera = read_camera(calibration_path, (image.shape[0], image.shape[1]))
    check_picture(camera, image_path, calibration_path)
    return image, camera


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


def check_picture(camera: Camera, image_path: Path, calibration_path: Path) -> None:
    """Raise ``InputError`` if the image's size does not fit the calibration.

    The principal point of a real camera is near the centre of its images. One that is far off
    means that the image was resized or cropped, and ``calib.txt`` was not adapted.
    """
    height, width = camera.image_size
    u, v = camera.projection[:2, 2] / (camera.projection[2, 2] or 1.0)
    off_x, off_y = abs(u - width / 2) / width, abs(v - height / 2) / height
    if off_x > MAX_OFF_CENTER[0] or off_y > MAX_OFF_CENTER[1]:
        raise InputError(
            f"{image_path}: wrong image size: {width} x {height} pixels do not belong to "
            f"{calibration_path}, whose P2 has its principal point at ({u:.0f}, {v:.0f}): "
            "use the image in its original size, or a calib.txt for this size"
        )


def image_size_of(path: Path) -> tuple[int, int]:
    """(height, width) of an image file; a PNG is not decoded for it."""
    try:
        with path.open("rb") as file:
            head = file.read(24)
    except OSError:
        head = b""
    if len(head) == 24 and head.startswith(b"\x89PNG\r\n\x1a\n") and head[12:16] == b"IHDR":
        return int.from_bytes(head[20:24], "big"), int.from_bytes(head[16:20], "big")
    height, width = read_image(path).shape[:2]
    return height, width
