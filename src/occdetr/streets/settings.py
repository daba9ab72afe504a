"""The settings that determine a set of synthetic streets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from occdetr.data.frames import TRAIN_SEQUENCES
from occdetr.errors import NOT_NEGATIVE, InputError, Range, check_range, check_ranges
from occdetr.geometry.camera import Camera, check_image_size
from occdetr.geometry.kitti import FIELD_OF_VIEW, KITTI_IMAGE_SIZE, kitti_camera

FRAME_STRIDE = 5  # every fifth scan has voxels
MAX_SCANS = 40


@dataclass(frozen=True)
class StreetSettings:
    """What determines the files of a set of streets.

    ``num_train`` and ``num_val`` are numbers of frames with voxels; the worlds of the two splits
    never share a seed. ``street_image_size`` is (height, width), ``horizontal_fov`` in degrees
    (None: KITTI's camera). Each world gives ``scans_per_world`` images at 10 Hz and voxels for
    every fifth.

    Raises ``InputError`` on values out of range.
    """

    num_train: int
    num_val: int
    seed: int = 0
    street_image_size: Sequence[int] = KITTI_IMAGE_SIZE
    horizontal_fov: float | None = None
    scans_per_world: int = 1

    def __post_init__(self) -> None:
        size = check_image_size("data.street_image_size", self.street_image_size)
        object.__setattr__(self, "street_image_size", size)
        counts = dict.fromkeys(("num_train", "num_val", "seed"), NOT_NEGATIVE)
        check_ranges("data", self, **counts, scans_per_world=Range(1, MAX_SCANS))
        check_range("data.horizontal_fov", self.horizontal_fov, FIELD_OF_VIEW)
        for name in ("num_train", "num_val"):
            if getattr(self, name) % self.frames_per_world:
                raise InputError(
                    f"data.{name}={getattr(self, name)}: give a multiple of "
                    f"{self.frames_per_world}, the number of frames with voxels in a world of "
                    f"data.scans_per_world={self.scans_per_world}"
                )

    @property
    def camera(self) -> Camera:
        height, width = self.street_image_size
        return kitti_camera((height, width), self.horizontal_fov)

    @property
    def frames_per_world(self) -> int:
        """Frames with voxels among the scans of a world."""
        return -(-self.scans_per_world // FRAME_STRIDE)

    @property
    def train_sequences(self) -> tuple[str, ...]:
        """The training sequences that hold frames."""
        worlds = -(-self.num_train // self.frames_per_world)
        return TRAIN_SEQUENCES[: min(worlds, len(TRAIN_SEQUENCES))]
