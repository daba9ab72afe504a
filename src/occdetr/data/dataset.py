"""Frames as the network takes them: pictures of one size, cameras to match, targets, batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from occdetr.data.augment import (
    crop_calibration,
    crop_image,
    crop_objects,
    draw_window,
    flip_calibration,
    flip_objects,
    jitter_colors,
)
from occdetr.data.cache import load_or_build
from occdetr.data.frames import Frame
from occdetr.data.objects import ObjectSettings, SceneObjects
from occdetr.data.semantickitti import read_labels
from occdetr.errors import InputError
from occdetr.files import read_image
from occdetr.geometry.camera import Camera, scale_projection
from occdetr.geometry.kitti import Calibration, read_calibration
from occdetr.geometry.rois import match_rois
from occdetr.structures import SceneBatch, SceneTarget

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

# How far the principal point may be from the picture's middle, as a share of width and height.
MAX_OFF_CENTER = (0.25, 0.35)

#: An index into the frames, or (epoch, index) as ``FrameSampler`` gives it for training.
FrameIndex = int | tuple[int, int]


@dataclass
class SceneItem:
    """One frame, ready to be collated. Fields as in ``SceneBatch``, without the batch axis."""

    image: Float[Tensor, "3 height width"]
    camera: Camera
    frame_index: int
    frame_id: str
    labels: UInt8[Tensor, "x y z"] | None = None
    target: SceneTarget | None = None


class SceneDataset(Dataset[SceneItem]):
    """Frames of a dataset folder.

    ``image_size`` is the network's (height, width). With labels, objects come from the cache
    (``objects`` None: no objects) and, if ``rois`` [token, 4] are given, are matched with them
    early, here in the data worker, after augmentation. ``scale``, (least, most), is by how much a
    random part of a picture is enlarged to take the place of the whole ((1, 1): it is the whole),
    ``flip`` the probability of mirroring a frame left to right, ``photometric`` the strength of
    colour changes; what is drawn depends on ``seed``, epoch and frame alone, so not on the number
    of workers. With ``exchange_images`` every frame gets the picture of another one: what a model
    says then it cannot have seen.

    Raises ``InputError``, naming the file, when a file is missing or broken or a picture does not
    belong to its calibration.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        image_size: tuple[int, int],
        objects: ObjectSettings | None = None,
        rois: Float32[NDArray, "token 4"] | None = None,
        with_labels: bool = True,
        cache_dir: Path | None = None,
        flip: float = 0.0,
        photometric: float = 0.0,
        scale: tuple[float, float] = (1.0, 1.0),
        seed: int = 0,
        exchange_images: bool = False,
    ) -> None:
        self.frames = list(frames)
        self.image_size = image_size
        self.objects = objects or ObjectSettings(classes=())
        self.rois = rois
        self.with_labels = with_labels
        self.cache_dir = cache_dir
        self.flip = flip
        self.photometric = photometric
        self.scale = scale
        self.seed = seed
        self.exchange_images = exchange_images

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: FrameIndex) -> SceneItem:
        epoch, position = index if isinstance(index, tuple) else (0, index)
        frame = self.frames[position]
        rng = np.random.default_rng([self.seed, epoch, position])
        pictured = self.frames[self._pictured(position)]
        image, calibration = read_picture(pictured.image, pictured.calibration)
        labels, objects = self._truth(frame) if self.with_labels else (None, None)
        if self.scale != (1.0, 1.0):
            window = draw_window(image.shape[:2], self.scale, rng)
            image, calibration = crop_image(image, window), crop_calibration(calibration, window)
            if labels is not None and objects is not None:
                objects = crop_objects(objects, labels, calibration, window, self.objects)
        image, calibration = resize_image(image, calibration, self.image_size)
        if self.photometric > 0:
            image = jitter_colors(image, self.photometric, rng)
        if rng.random() < self.flip:
            image, labels = image[:, ::-1], None if labels is None else labels[:, ::-1]
            calibration = flip_calibration(calibration, self.image_size[1])
            objects = None if objects is None else flip_objects(objects)
        item = make_item(image, calibration, position, frame.id)
        if labels is not None and objects is not None:
            item.labels = torch.from_numpy(np.ascontiguousarray(labels))
            item.target = make_target(objects, self.rois)
        return item

    def _pictured(self, position: int) -> int:
        """The frame whose picture a frame has: its own, or that of one half the frames away."""
        if not self.exchange_images:
            return position
        return (position + max(len(self.frames) // 2, 1)) % len(self.frames)

    def _truth(self, frame: Frame) -> tuple[UInt8[NDArray, "x y z"], SceneObjects]:
        return read_labels(frame), load_or_build(frame, self.objects, self.cache_dir)


class PictureDataset(Dataset[SceneItem]):
    """Pictures of one camera, outside any dataset folder; ``calibration`` is a KITTI ``calib.txt``.

    ``image_size`` is the network's (height, width). Frame ids are the pictures' names.
    """

    def __init__(
        self, images: Sequence[Path], calibration: Path, image_size: tuple[int, int]
    ) -> None:
        self.images = [Path(image) for image in images]
        self.calibration = Path(calibration)
        self.image_size = image_size

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> SceneItem:
        path = self.images[index]
        image, calibration = load_picture(path, self.calibration, self.image_size)
        return make_item(image, calibration, index, path.stem)


def load_picture(
    image_path: Path, calibration_path: Path, image_size: tuple[int, int]
) -> tuple[UInt8[NDArray, "height width 3"], Calibration]:
    """A picture brought to ``image_size`` (height, width), and its camera with it."""
    return resize_image(*read_picture(image_path, calibration_path), image_size)


def read_picture(
    image_path: Path, calibration_path: Path
) -> tuple[UInt8[NDArray, "height width 3"], Calibration]:
    """A picture as it lies on disk, and its camera. Raises ``InputError`` if they do not belong
    together."""
    image, calibration = read_image(image_path), read_calibration(calibration_path)
    height, width = image.shape[:2]
    check_picture((height, width), calibration, image_path, calibration_path)
    return image, calibration


def resize_image(
    image: UInt8[NDArray, "height width 3"],
    calibration: Calibration,
    image_size: tuple[int, int],
) -> tuple[UInt8[NDArray, "new_height new_width 3"], Calibration]:
    """A picture brought to ``image_size`` (height, width), and its camera with it."""
    height, width = image.shape[:2]
    scale_x, scale_y = image_size[1] / width, image_size[0] / height
    if (scale_x, scale_y) != (1.0, 1.0):
        method = cv2.INTER_AREA if max(scale_x, scale_y) <= 1 else cv2.INTER_LINEAR
        image = cv2.resize(image, (image_size[1], image_size[0]), interpolation=method)
    projection = scale_projection(calibration.projection, scale_x, scale_y)
    return image, Calibration(projection, calibration.lidar_to_camera)


def check_picture(
    size: tuple[int, int], calibration: Calibration, image_path: Path, calibration_path: Path
) -> None:
    """Raise ``InputError`` if a picture of ``size`` (height, width) is not the camera's.

    The principal point of a real camera is near the middle of its picture. One that is far off
    means that the picture was resized or cropped, and ``calib.txt`` was not.
    """
    height, width = size
    projection = calibration.projection
    u, v = projection[:2, 2] / (projection[2, 2] or 1.0)
    off_x, off_y = abs(u - width / 2) / width, abs(v - height / 2) / height
    if off_x > MAX_OFF_CENTER[0] or off_y > MAX_OFF_CENTER[1]:
        raise InputError(
            f"{image_path}: wrong image size: {width} x {height} pixels do not belong to "
            f"{calibration_path}, whose P2 has its principal point at ({u:.0f}, {v:.0f}): "
            "use the picture as the camera gave it, or a calib.txt for this size"
        )


def make_item(
    image: UInt8[NDArray, "height width 3"], calibration: Calibration, index: int, name: str
) -> SceneItem:
    """Normalise a picture with ImageNet's mean and deviation; everything in float32."""
    return SceneItem(
        image=torch.from_numpy(normalize_image(image)),
        camera=Camera(
            torch.from_numpy(calibration.projection.astype(np.float32)),
            torch.from_numpy(calibration.lidar_to_camera.astype(np.float32)),
            (image.shape[0], image.shape[1]),
        ),
        frame_index=index,
        frame_id=name,
    )


def normalize_image(
    image: UInt8[NDArray, "height width 3"],
) -> Float32[NDArray, "3 height width"]:
    """An RGB picture as the network takes it."""
    scale = 1 / (255 * np.array(IMAGENET_STD, dtype=np.float32))
    shift = np.array(IMAGENET_MEAN, dtype=np.float32) / np.array(IMAGENET_STD, dtype=np.float32)
    channels = np.ascontiguousarray(image.transpose(2, 0, 1)).astype(np.float32)
    channels *= scale[:, None, None]
    channels -= shift[:, None, None]
    return channels


def make_target(
    objects: SceneObjects, rois: Float32[NDArray, "token 4"] | None = None
) -> SceneTarget:
    """Objects as tensors, with early matching; without ``rois`` every ``roi_indices`` is -1."""
    if rois is None:
        matched = np.full(len(objects), -1, dtype=np.int64)
    else:
        matched = match_rois(objects.boxes_cxcywh, rois)
    return SceneTarget(
        classes=torch.from_numpy(objects.classes),
        boxes_cxcywh=torch.from_numpy(objects.boxes_cxcywh),
        boxes3d_camera=torch.from_numpy(objects.boxes3d_camera),
        boxes3d_grid=torch.from_numpy(objects.boxes3d_grid),
        voxels=torch.from_numpy(objects.voxels),
        voxel_object=torch.from_numpy(objects.voxel_object.astype(np.int64)),
        visible_fraction=torch.from_numpy(objects.visible_fraction),
        roi_indices=torch.from_numpy(matched),
    )


def collate(items: Sequence[SceneItem]) -> SceneBatch:
    """Frames to a batch; labels and targets are absent if a frame has none."""
    labels = [item.labels for item in items if item.labels is not None]
    targets = [item.target for item in items if item.target is not None]
    return SceneBatch(
        images=torch.stack([item.image for item in items]),
        camera=Camera(
            torch.stack([torch.as_tensor(item.camera.projection) for item in items]),
            torch.stack([torch.as_tensor(item.camera.lidar_to_camera) for item in items]),
            items[0].camera.image_size,
        ),
        frame_indices=torch.tensor([item.frame_index for item in items]),
        frame_ids=[item.frame_id for item in items],
        labels=torch.stack(labels) if len(labels) == len(items) else None,
        targets=targets if len(targets) == len(items) else None,
    )
