"""Datasets of frames as the network takes them: image, camera, voxel labels and targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from occdetr.data.augment import (
    Augmentation,
    change_sensor,
    crop_objects,
    crop_picture,
    draw_window,
    flip_objects,
    jitter_colors,
)
from occdetr.data.cache import ObjectCache
from occdetr.data.early_matching import match_rois
from occdetr.data.frames import Frame
from occdetr.data.images import load_picture, read_picture, resize_picture
from occdetr.data.objects import SceneObjects
from occdetr.data.semantickitti import read_labels
from occdetr.errors import POSITIVE, check_range
from occdetr.geometry.camera import Camera, check_image_size, flip_camera
from occdetr.geometry.rois import check_strides, preset_rois
from occdetr.structures import SceneBatch, SceneTarget

#: An index into the frames, or (epoch, index) as ``FrameSampler`` gives it for training.
FrameIndex = int | tuple[int, int]


@dataclass(frozen=True)
class NetworkInput:
    """What the loaders need to know of a network: its image size (height, width), and the strides
    and the scale of its preset ROIs for early matching."""

    image_size: Sequence[int]
    strides: Sequence[int] = (8, 16, 32, 64)
    roi_scale: float = 4.0

    def __post_init__(self) -> None:
        size = check_image_size("data.image_size", self.image_size)
        object.__setattr__(self, "image_size", size)
        check_strides("data.strides", self.strides)
        check_range("data.roi_scale", self.roi_scale, POSITIVE)

    @cached_property
    def rois(self) -> Float32[NDArray, "token 4"]:
        """The preset ROIs, normalised cxcywh."""
        height, width = self.image_size
        return preset_rois((height, width), tuple(self.strides), float(self.roi_scale))


@dataclass
class SceneItem:
    """One frame, ready to be collated. Fields as in ``SceneBatch``, without the batch axis."""

    image: UInt8[Tensor, "3 height width"]
    camera: Camera
    frame_index: int
    frame_id: str
    labels: UInt8[Tensor, "x y z"] | None = None
    target: SceneTarget | None = None


class _Truth(NamedTuple):
    """The ground truth of a frame."""

    labels: UInt8[NDArray, "x y z"]
    objects: SceneObjects


class SceneDataset(Dataset[SceneItem]):
    """Frames of a dataset folder, resized for a network and augmented.

    With ``labels``, each item has voxel labels and a target: the objects come from this cache and
    are matched to the network's preset ROIs after augmentation. Without, it has neither.
    Augmentation depends only on ``seed``, epoch and frame, so not on the number of workers. With
    ``exchange_images`` every frame gets the image of another frame, which measures what a network
    predicts without seeing the scene.

    Raises ``InputError``, naming the file, if a file is missing or broken or an image does not fit
    its calibration.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        network: NetworkInput,
        labels: ObjectCache | None = None,
        augmentation: Augmentation | None = None,
        seed: int = 0,
        exchange_images: bool = False,
    ) -> None:
        self.frames = list(frames)
        self.network = network
        self.labels = labels
        self.augmentation = augmentation or Augmentation()
        self.seed = seed
        self.exchange_images = exchange_images

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: FrameIndex) -> SceneItem:
        epoch, position = index if isinstance(index, tuple) else (0, index)
        frame, source = self.frames[position], self.frames[self._image_source(position)]
        rng = np.random.default_rng([self.seed, epoch, position])
        image, camera = read_picture(source.image, source.calibration)
        truth = None
        if self.labels is not None:
            truth = _Truth(read_labels(frame), self.labels.load_or_build(frame))
        image, camera, truth = self._augment(image, camera, truth, rng)
        item = make_item(image, camera, position, frame.id)
        if truth is not None:
            item.labels = torch.from_numpy(np.ascontiguousarray(truth.labels))
            item.target = make_target(truth.objects, self.network.rois)
        return item

    def _image_source(self, position: int) -> int:
        """The frame whose image a frame gets: its own, or one half of all frames further."""
        if not self.exchange_images:
            return position
        return (position + max(len(self.frames) // 2, 1)) % len(self.frames)

    def _augment(
        self,
        image: UInt8[NDArray, "height width 3"],
        camera: Camera,
        truth: _Truth | None,
        rng: np.random.Generator,
    ) -> tuple[UInt8[NDArray, "new_height new_width 3"], Camera, _Truth | None]:
        """Crop, resize to the network's size, change colours and flip, each as configured."""
        chosen = self.augmentation
        if chosen.scale != (1.0, 1.0):
            window = draw_window(camera.image_size, chosen.scale, rng)
            image, camera = crop_picture(image, camera, window)
            if truth is not None and self.labels is not None:
                objects = crop_objects(truth.objects, truth.labels, camera, self.labels.settings)
                truth = _Truth(truth.labels, objects)
        height, width = self.network.image_size
        image, camera = resize_picture(image, camera, (height, width))
        if chosen.photometric > 0:
            image = jitter_colors(image, chosen.photometric, rng)
        if chosen.sensor > 0:
            image = change_sensor(image, chosen.sensor, rng)
        if rng.random() < chosen.flip:
            image, camera = cv2.flip(image, 1), flip_camera(camera)
            if truth is not None:
                truth = _Truth(truth.labels[:, ::-1], flip_objects(truth.objects))
        return image, camera, truth


class PictureDataset(Dataset[SceneItem]):
    """Image files of one camera without labels; ``calibration`` is a KITTI ``calib.txt``.

    ``image_size`` is the network's (height, width). Frame ids are the files' names without suffix.
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
        image, camera = load_picture(path, self.calibration, self.image_size)
        return make_item(image, camera, index, path.stem)


def make_item(
    image: UInt8[NDArray, "height width 3"], camera: Camera, index: int, name: str
) -> SceneItem:
    """An item without labels: the image's bytes, channels first, and its camera in float32."""
    return SceneItem(
        image=torch.from_numpy(image).permute(2, 0, 1),
        camera=Camera(
            torch.from_numpy(np.asarray(camera.projection, dtype=np.float32)),
            torch.from_numpy(np.asarray(camera.lidar_to_camera, dtype=np.float32)),
            camera.image_size,
        ),
        frame_index=index,
        frame_id=name,
    )


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
