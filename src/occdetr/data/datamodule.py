"""The loaders of a training, an evaluation and a prediction, as a LightningDataModule."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import lightning
import torch
from torch.utils.data import DataLoader

from occdetr.data.cache import CACHE_FOLDER
from occdetr.data.dataset import SceneDataset, SceneItem, collate
from occdetr.data.frames import (
    TEST_SEQUENCES,
    TRAIN_SEQUENCES,
    VAL_SEQUENCES,
    Frame,
    find_frames,
    summarize_frames,
)
from occdetr.data.objects import ObjectSettings
from occdetr.data.preparation import PreparedFrame, PreparedFrames, prepare_frames
from occdetr.data.sampler import FrameSampler
from occdetr.errors import InputError
from occdetr.geometry.rois import preset_rois

SPLITS = ("train", "val", "test")

MAX_SCALE = 4.0  # of a picture of KITTI's size, a part of 92 x 306 pixels


class SceneDataModule(lightning.LightningDataModule):
    """A dataset folder in SemanticKITTI's layout; every loader gives ``SceneBatch``.

    Args:
        root: the folder that holds ``sequences``.
        image_size: the network's (height, width).
        objects: which classes are objects (the partition) and how they are made from voxels.
        strides, roi_scale: the network's preset ROIs, for early matching in the data workers.
        train_sequences, val_sequences, test_sequences: the test split needs no labels.
        stride: take frames whose number is a multiple of it (5 is the usual download).
        batch_size, num_workers, pin_memory: of the loaders.
        flip, photometric, scale: augmentation in training: the probability of mirroring a frame,
            the strength of colour changes, and [least, most] by which a random part of a picture is
            enlarged to take the place of the whole ([1, 1]: none); see ``SceneDataset``.
        cache_dir: where object labels are kept; default ``<root>/.occdetr_cache``.
        shuffle_seed: of shuffling and augmentation.
        eval_split: the labelled split that ``test_dataloader`` gives, ``train`` or ``val``.
        exchange_images: whether each of its frames gets the picture of another one.

    Raises ``InputError`` on settings that mean nothing, and from ``frames`` on, on missing files.
    """

    def __init__(
        self,
        root: str | Path,
        image_size: Sequence[int],
        objects: ObjectSettings | None = None,
        strides: Sequence[int] = (8, 16, 32, 64),
        roi_scale: float = 4.0,
        train_sequences: Sequence[str | int] = TRAIN_SEQUENCES,
        val_sequences: Sequence[str | int] = VAL_SEQUENCES,
        test_sequences: Sequence[str | int] = TEST_SEQUENCES,
        stride: int = 5,
        batch_size: int = 1,
        num_workers: int = 0,
        pin_memory: bool = False,
        flip: float = 0.0,
        photometric: float = 0.0,
        scale: Sequence[float] = (1.0, 1.0),
        cache_dir: str | Path | None = None,
        shuffle_seed: int = 0,
        eval_split: str = "val",
        exchange_images: bool = False,
    ) -> None:
        super().__init__()
        self.root = Path(root)
        self.image_size = (int(image_size[0]), int(image_size[1]))
        self.rois = preset_rois(self.image_size, tuple(strides), float(roi_scale))
        sequences = (train_sequences, val_sequences, test_sequences)
        self.sequences = dict(zip(SPLITS, map(tuple, sequences), strict=True))
        self.stride = int(stride)
        self.object_settings = objects or ObjectSettings()
        self.batch_size = int(batch_size)
        self.num_workers = int(num_workers)
        self.pin_memory = bool(pin_memory)
        self.flip = float(flip)
        self.photometric = float(photometric)
        self.scale = _scale_range(scale)
        self.cache_dir = Path(cache_dir) if cache_dir else self.root / CACHE_FOLDER
        self.shuffle_seed = int(shuffle_seed)
        self.eval_split = eval_split
        self.exchange_images = bool(exchange_images)
        self._frames: dict[str, list[Frame]] = {}
        self._check()

    def _check(self) -> None:
        if self.eval_split not in ("train", "val"):
            raise InputError(
                f"data.eval_split={self.eval_split}: labels exist for train and val only; "
                "the test split is for prediction"
            )
        for name, value, least in (("batch_size", self.batch_size, 1), ("stride", self.stride, 1)):
            if value < least:
                raise InputError(f"data.{name}={value}: give {least} or more")
        if self.num_workers < 0:
            raise InputError(f"data.num_workers={self.num_workers}: give 0 or more")
        if not 0 <= self.flip <= 1:
            raise InputError(f"data.flip={self.flip}: it is a probability, from 0 to 1")
        if not 0 <= self.photometric < 1:
            raise InputError(f"data.photometric={self.photometric}: give a strength from 0 to 1")

    def frames(self, split: str) -> list[Frame]:
        """The frames of ``train``, ``val`` or ``test``, in order; ``frame_indices`` count them."""
        if split not in self._frames:
            if split not in SPLITS:
                raise InputError(f"split={split}: choose one of {', '.join(SPLITS)}")
            labels = split != "test"
            found = find_frames(self.root, self.sequences[split], self.stride, labels)
            self._frames[split] = found
        return self._frames[split]

    def summary(self, split: str) -> str:
        """One line: how many frames were found, where."""
        return f"{split}: {summarize_frames(self.frames(split), self.stride)} in {self.root}"

    def setup(self, stage: str) -> None:
        """Find the frames, so that a missing folder stops the run before it starts.

        Raises ``InputError`` too if a process would have no frame to evaluate: Lightning lets it
        skip the end of the epoch, where the others wait for its share of the figures.
        """
        needed = {"fit": ("train", "val"), "validate": ("val",), "test": (self.eval_split,)}
        splits = needed.get(stage, ("test",))
        counts = [len(self.frames(split)) for split in splits]
        _, world_size = _place(self.trainer)
        if counts[-1] < world_size:  # the last one is evaluated
            raise InputError(
                f"trainer.devices: {world_size} processes for {self.summary(splits[-1])}: "
                "use no more than there are frames"
            )

    def prepare_objects(
        self,
        splits: Sequence[str] = ("train", "val"),
        num_workers: int = 1,
        progress: bool = True,
        shard: tuple[int, int] = (1, 1),
        rebuild: bool = False,
        on_frame: Callable[[PreparedFrame], None] | None = None,
    ) -> PreparedFrames:
        """Make and cache the object labels of whole splits. Loaders do the same by themselves.

        ``shard`` (i, n) is the share of the i-th of n machines, counted from 1: every n-th frame.
        Further keywords as in ``prepare_frames``.
        """
        number, count = shard
        frames = dict.fromkeys(frame for split in splits for frame in self.frames(split))
        return prepare_frames(
            list(frames)[number - 1 :: count],
            self.object_settings,
            self.cache_dir,
            num_workers,
            progress,
            rebuild,
            self.rois,
            on_frame,
        )

    def dataset(
        self,
        split: str,
        with_labels: bool = True,
        augment: bool = False,
        exchange_images: bool = False,
    ) -> SceneDataset:
        """The frames of a split as items; ``augment`` as configured for training.

        With ``exchange_images`` every frame gets the picture of another one.
        """
        return SceneDataset(
            self.frames(split),
            self.image_size,
            objects=self.object_settings,
            rois=self.rois,
            with_labels=with_labels,
            cache_dir=self.cache_dir,
            flip=self.flip if augment else 0.0,
            photometric=self.photometric if augment else 0.0,
            scale=self.scale if augment else (1.0, 1.0),
            seed=self.shuffle_seed,
            exchange_images=exchange_images,
        )

    def train_dataloader(self) -> DataLoader[SceneItem]:
        return self._loader(self.dataset("train", augment=True), shuffle=True)

    def val_dataloader(self) -> DataLoader[SceneItem]:
        return self._loader(self.dataset("val"))

    def test_dataloader(self) -> DataLoader[SceneItem]:
        """The labelled frames of ``eval_split``."""
        dataset = self.dataset(self.eval_split, exchange_images=self.exchange_images)
        if self.exchange_images and len(dataset) < 2:
            raise InputError(f"{self.root}: exchange_images=true: the split has one frame alone")
        return self._loader(dataset)

    def predict_dataloader(self) -> DataLoader[SceneItem]:
        """The pictures of the test split."""
        return self._loader(self.dataset("test", with_labels=False))

    def _loader(self, dataset: SceneDataset, shuffle: bool = False) -> DataLoader[SceneItem]:
        rank, world_size = _place(self.trainer)
        return DataLoader(
            dataset,  # pyright: ignore[reportArgumentType]
            batch_size=self.batch_size,
            sampler=FrameSampler(dataset, shuffle, self.shuffle_seed, rank, world_size),
            num_workers=self.num_workers,
            collate_fn=collate,
            pin_memory=self.pin_memory and torch.cuda.is_available(),
            persistent_workers=self.num_workers > 0,
            worker_init_fn=_start_worker if self.num_workers else None,
        )


def _scale_range(scale: Sequence[float]) -> tuple[float, float]:
    """(least, most) of the setting ``scale``."""
    try:
        least, most = map(float, scale)
    except (TypeError, ValueError):
        least = most = math.nan
    if not 1 <= least <= most <= MAX_SCALE:  # false for NaN too
        raise InputError(
            f"data.scale={scale}: give [least, most] with 1 <= least <= most <= {MAX_SCALE:g}, "
            "as in [1.0, 1.25]; [1.0, 1.0] is none"
        )
    return least, most


def _place(trainer: lightning.Trainer | None) -> tuple[int, int]:
    """(rank, world size) of this process."""
    if trainer is not None:
        return trainer.global_rank, trainer.world_size
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def _start_worker(worker: int) -> None:
    cv2.setNumThreads(0)  # workers are the parallelism; OpenCV's threads would fight them
