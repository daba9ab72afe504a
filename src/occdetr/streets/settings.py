"""The settings that determine a set of synthetic streets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from occdetr.data.frames import TRAIN_SEQUENCES
from occdetr.errors import NOT_NEGATIVE, InputError, Range, check_each, check_range, check_ranges
from occdetr.geometry.camera import Camera, check_image_size
from occdetr.geometry.kitti import (
    FIELD_OF_VIEW,
    KITTI_CAMERA_HEIGHT,
    KITTI_IMAGE_SIZE,
    kitti_camera,
)
from occdetr.streets.drive import KITTI_TILT

FRAME_STRIDE = 5  # every fifth scan has voxels
MAX_SCANS = 40
CAMERA_HEIGHT = Range(0.5, 6)  # metres
CAMERA_PITCH = Range(-30, 30)  # degrees


@dataclass(frozen=True)
class StreetSettings:
    """What determines the files of a set of streets.

    ``num_train`` and ``num_val`` are numbers of frames with voxels; the worlds of the two splits
    never share a seed. ``street_image_size`` is (height, width), ``horizontal_fov`` in degrees
    (None: KITTI's camera). ``camera_height`` is in metres above the ground (None: KITTI's),
    ``camera_pitch`` in degrees upwards; with ``training_heights`` (lowest, highest) each of the ten
    training sequences has a camera height of its own, evenly spaced. The grid stays where it is.
    With ``sensor_tilt`` the grid and the camera are tilted against the road, in each world by other
    angles, as KITTI's are (``drive.draw_tilt``).
    Each world gives ``scans_per_world`` images at 10 Hz and voxels for every fifth.

    Raises ``InputError`` on values out of range.
    """

    num_train: int
    num_val: int
    seed: int = 0
    street_image_size: Sequence[int] = KITTI_IMAGE_SIZE
    horizontal_fov: float | None = None
    camera_height: float | None = None
    camera_pitch: float = 0.0
    training_heights: Sequence[float] | None = None
    sensor_tilt: bool = False
    scans_per_world: int = 1

    def __post_init__(self) -> None:
        size = check_image_size("data.street_image_size", self.street_image_size)
        object.__setattr__(self, "street_image_size", size)
        counts = dict.fromkeys(("num_train", "num_val", "seed"), NOT_NEGATIVE)
        check_ranges("data", self, **counts, scans_per_world=Range(1, MAX_SCANS))
        check_range("data.horizontal_fov", self.horizontal_fov, FIELD_OF_VIEW)
        check_range("data.camera_height", self.camera_height, CAMERA_HEIGHT)
        check_range("data.camera_pitch", self.camera_pitch, CAMERA_PITCH)
        if (heights := self.training_heights) is not None:
            check_each("data.training_heights", heights, CAMERA_HEIGHT)
            if len(heights) != 2 or heights[0] > heights[1]:
                raise InputError(
                    f"data.training_heights={list(heights)}: give [lowest, highest] in metres"
                )
        for name in ("num_train", "num_val"):
            if getattr(self, name) % self.frames_per_world:
                raise InputError(
                    f"data.{name}={getattr(self, name)}: give a multiple of "
                    f"{self.frames_per_world}, the number of frames with voxels in a world of "
                    f"data.scans_per_world={self.scans_per_world}"
                )

    def camera(self, training_sequence: int | None = None) -> Camera:
        """The camera of a training sequence, by its number from 0, or of validation."""
        height, width = self.street_image_size
        metres = self.camera_height
        if training_sequence is not None and self.training_heights is not None:
            lowest, highest = self.training_heights
            share = training_sequence / (len(TRAIN_SEQUENCES) - 1)
            metres = lowest + share * (highest - lowest)
        camera = kitti_camera((height, width), self.horizontal_fov)
        return raise_and_tilt(camera, metres, self.camera_pitch)

    def mounting(self) -> dict[str, Any] | None:
        """What differs from KITTI's mounting; None if nothing does."""
        heights = None if self.training_heights is None else list(self.training_heights)
        own = {"height": self.camera_height, "pitch": self.camera_pitch, "heights": heights}
        own |= {"tilt": vars(KITTI_TILT)} if self.sensor_tilt else {}
        return own if any(own.values()) else None

    @property
    def frames_per_world(self) -> int:
        """Frames with voxels among the scans of a world."""
        return -(-self.scans_per_world // FRAME_STRIDE)

    @property
    def train_sequences(self) -> tuple[str, ...]:
        """The training sequences that hold frames."""
        worlds = -(-self.num_train // self.frames_per_world)
        return TRAIN_SEQUENCES[: min(worlds, len(TRAIN_SEQUENCES))]


def raise_and_tilt(camera: Camera, height: float | None, pitch: float) -> Camera:
    """A camera mounted as KITTI's at another ``height`` above the ground (metres; None: the same),
    and turned upwards by ``pitch`` degrees."""
    transform = np.array(camera.lidar_to_camera, dtype=np.float64)
    if height is not None:
        transform[:3, 3] -= transform[:3, 2] * (height - KITTI_CAMERA_HEIGHT)
    turn, angle = np.eye(4), math.radians(pitch)
    turn[1:3, 1:3] = [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
    return Camera(camera.projection, turn @ transform, camera.image_size)
