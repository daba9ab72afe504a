"""The loaders of training, evaluation and prediction, as a LightningDataModule."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import cv2
import lightning
import torch
from torch.utils.data import DataLoader

from occdetr import use_all_cores
from occdetr.data.augment import Augmentation
from occdetr.data.cache import CACHE_FOLDER, ObjectCache
from occdetr.data.dataset import NetworkInput, SceneDataset, SceneItem, collate
from occdetr.data.frames import (
    LABELLED_SPLITS,
    SPLITS,
    TEST_SEQUENCES,
    TRAIN_SEQUENCES,
    VAL_SEQUENCES,
    Frame,
    find_extra_frames,
    find_frames,
    summarize_frames,
)
from occdetr.data.objects import ObjectSettings
from occdetr.data.preparation import FrameResult, PreparationResult, prepare_frames
from occdetr.data.processes import check_shared_memory
from occdetr.data.sampler import FrameSampler
from occdetr.data.train_position import TrainPosition, position_of
from occdetr.data.transport import share_batches
from occdetr.data.worker_signals import leave_signals_to_parent
from occdetr.errors import (
    BATCH,
    COUNT,
    NOT_NEGATIVE,
    PROCESSES,
    InputError,
    check_ranges,
)
from occdetr.files import check_folder
from occdetr.geometry.voxels import GRID_SHAPE

Part = TypeVar("Part")


@dataclass(frozen=True)
class DatasetFolder:
    """A folder in SemanticKITTI's layout and the frames of it to use.

    ``root`` holds the folder ``sequences``. The test split needs no labels. Frames are used whose
    number is a multiple of ``stride`` (SemanticKITTI's download has voxels for every fifth).
    ``allow_partial`` leaves out frames that lack a file, which is an error otherwise.
    ``cache_dir`` is where object labels are kept; None: ``<root>/.occdetr_cache``.

    An epoch of training passes over the frames of ``train_sequences`` ``repeats`` times, and once
    over those of the dataset folders ``extra_roots`` (see ``find_extra_frames``).
    """

    root: str | Path
    train_sequences: Sequence[str | int] = TRAIN_SEQUENCES
    val_sequences: Sequence[str | int] = VAL_SEQUENCES
    test_sequences: Sequence[str | int] = TEST_SEQUENCES
    stride: int = 5
    allow_partial: bool = False
    cache_dir: str | Path | None = None
    repeats: int = 1
    extra_roots: Sequence[str | Path] = ()

    def __post_init__(self) -> None:
        check_ranges("data", self, stride=COUNT, repeats=COUNT)
        given = self.extra_roots
        if not isinstance(given, Sequence) or isinstance(given, str):
            raise InputError(f"data.extra_roots={given}: give a list of folders, as in [{given}]")
        places = [os.path.realpath(root) for root in (self.root, *given)]
        for root, place in zip(given, places[1:], strict=True):
            check_folder("data.extra_roots", root)
            if places.count(place) > 1:
                raise InputError(
                    f"data.extra_roots={list(map(str, given))}: {root} is given twice, or is "
                    "data.root: name each folder once (data.repeats repeats data.root)"
                )


@dataclass(frozen=True)
class Loading:
    """How batches are loaded: by ``num_workers`` processes (0: in this one), page-locked on a GPU
    if ``pin_memory``, in an order that ``shuffle_seed`` draws for training, as it does the
    augmentation."""

    batch_size: int = 1
    num_workers: int = 0
    pin_memory: bool = False
    shuffle_seed: int = 0

    def __post_init__(self) -> None:
        check_ranges("data", self, batch_size=BATCH, num_workers=PROCESSES)
        check_ranges("data", self, shuffle_seed=NOT_NEGATIVE)


@dataclass(frozen=True)
class Evaluated:
    """What ``test_dataloader`` gives: the labelled split ``train`` or ``val``, and whether every
    frame gets the image of another one (see ``SceneDataset``)."""

    eval_split: str = "val"
    exchange_images: bool = False

    def __post_init__(self) -> None:
        if self.eval_split not in LABELLED_SPLITS:
            raise InputError(
                f"data.eval_split={self.eval_split}: labels exist for train and val only; "
                "the test split is for prediction"
            )


class SceneDataModule(lightning.LightningDataModule):
    """A dataset folder in SemanticKITTI's layout; every loader gives ``SceneBatch``.

    ``objects`` decides which classes are objects (the partition) and how they are made from voxels.
    ``settings`` are the fields of ``DatasetFolder``, ``Loading``, ``Augmentation`` (of training),
    ``Evaluated`` and ``NetworkInput`` by name, as ``conf/data`` has them: only ``root`` is needed,
    and ``image_size`` for datasets and loaders, because object labels do not depend on a network.

    Raises ``InputError`` on values out of range, and from ``frames`` on if files are missing;
    ``TypeError`` on other names.
    """

    #: Where the types of ``settings`` are declared.
    parts: ClassVar[tuple[type, ...]] = (
        *(DatasetFolder, Loading, Augmentation, Evaluated, NetworkInput),
    )

    def __init__(self, objects: ObjectSettings | None = None, **settings: Any) -> None:
        super().__init__()
        self.folder = take(DatasetFolder, settings)
        self.loading = take(Loading, settings)
        self.augmentation = take(Augmentation, settings)
        self.evaluated = take(Evaluated, settings)
        self.network = take(NetworkInput, settings) if "image_size" in settings else None
        if settings:
            names = ", ".join(f"data.{name}" for name in settings)
            without = " ".join(f"'~data.{name}'" for name in settings)
            raise InputError(
                f"{names}: {type(self).__name__}, which data= has chosen, has no such setting: "
                f"leave it out; if an experiment sets it, add {without}"
            )
        self.root = Path(self.folder.root)
        cache_dir = self.folder.cache_dir or self.root / CACHE_FOLDER
        check_folder("data.root", self.root)
        check_folder("data.cache_dir", cache_dir)
        self.labels = ObjectCache(objects or ObjectSettings(), Path(cache_dir))
        self._frames: dict[str, list[Frame]] = {}
        self.position = TrainPosition()

    def frames(self, split: str) -> list[Frame]:
        """The frames of ``train``, ``val`` or ``test``, in order; ``frame_indices`` index them."""
        if split not in SPLITS:
            raise InputError(f"split={split}: choose one of {', '.join(SPLITS)}")
        if split not in self._frames:
            sequences = getattr(self.folder, f"{split}_sequences")
            labels, folder = split in LABELLED_SPLITS, self.folder
            self._frames[split] = find_frames(
                self.root, sequences, folder.stride, labels, folder.allow_partial
            )
        return self._frames[split]

    def training_frames(self) -> list[Frame]:
        """What an epoch of training passes over: ``train``, as often as it is repeated, and the
        frames of the extra folders."""
        return self.frames("train") * self.folder.repeats + self.extra_frames

    @cached_property
    def extra_frames(self) -> list[Frame]:
        """The frames of ``extra_roots``."""
        stride, allow_partial = self.folder.stride, self.folder.allow_partial
        roots = self.folder.extra_roots
        found = [find_extra_frames(root, stride, allow_partial) for root in roots]
        return [frame for frames in found for frame in frames]

    def keep(self, split: str, frames: Sequence[Frame]) -> None:
        """Do with these frames of a split, as if there were no others."""
        self._frames[split] = list(frames)

    def summary(self, split: str) -> str:
        """The number of frames and where they are, in one line."""
        return f"{split}: {summarize_frames(self.frames(split), self.folder.stride)} in {self.root}"

    def training_summary(self) -> str:
        """``summary`` of ``train``, with what else an epoch of training passes over."""
        folder, text = self.folder, self.summary("train")
        if folder.repeats > 1:
            text += f", each {folder.repeats} times an epoch"
        if self.extra_frames:
            text += f", and {len(self.extra_frames):,} in {', '.join(map(str, folder.extra_roots))}"
        return text

    def setup(self, stage: str) -> None:
        """Find the frames, so that a missing folder stops the run before it starts.

        Raises ``InputError`` also if a process would have no frame to evaluate: Lightning lets it
        skip the end of the epoch, where the other processes wait for its metrics.
        """
        needed = {
            "fit": LABELLED_SPLITS,
            "validate": ("val",),
            "test": (self.evaluated.eval_split,),
        }
        splits = needed.get(stage, ("test",))
        counts = [len(self.frames(split)) for split in splits]
        rank, world_size = _rank_and_world_size(self.trainer)
        if stage == "fit":
            both = _images(self.training_frames()) & _images(self.frames("val"))
            if rank == 0 and (self.extra_frames or self.folder.repeats > 1):
                print(self.training_summary())
            if rank == 0 and both:
                print(f"note: {len(both)} frames are in train and in val: validation has seen them")
        if counts[-1] < world_size:  # the last split is evaluated
            raise InputError(
                f"trainer.devices: {world_size} processes for {self.summary(splits[-1])}: "
                "use no more than there are frames"
            )

    def state_dict(self) -> dict[str, Any]:
        """Where the training is in its data; Lightning keeps it in checkpoints."""
        assert self.trainer is not None
        position = position_of(self.trainer, self.position, self._frames_a_step())
        return {**dataclasses.asdict(position), "epoch_frames": len(self.training_frames())}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue there, also with another batch size or number of processes.

        Lightning calls it before it makes the loaders.
        """
        count, step = len(self.training_frames()), self._frames_a_step()
        state = {"epoch_frames": count, **state_dict}  # older checkpoints have none
        before = state.pop("epoch_frames")
        if before != count and _rank_and_world_size(self.trainer)[0] == 0:
            print(f"note: an epoch has {count} frames now, and had {before} before: check the data")
        saved = TrainPosition(**state)
        batches = -(-count // step) - -(-max(count - saved.frames, 0) // step)
        self.position = dataclasses.replace(saved, batches=batches)

    def _frames_a_step(self) -> int:
        return self.loading.batch_size * _rank_and_world_size(self.trainer)[1]

    def prepare_objects(
        self,
        splits: Sequence[str] = LABELLED_SPLITS,
        num_workers: int = 1,
        progress: bool = True,
        shard: tuple[int, int] = (1, 1),
        rebuild: bool = False,
        on_frame: Callable[[FrameResult], None] | None = None,
    ) -> PreparationResult:
        """Make and cache the object labels of whole splits, ``train`` with the extra folders;
        loaders make missing ones themselves.

        ``shard`` (i, n) selects the frames of the i-th of n machines, counted from 1: every n-th.
        The other arguments are those of ``prepare_frames``.
        """
        number, count = shard
        every = [
            self.training_frames() if each == "train" else self.frames(each) for each in splits
        ]
        frames = dict.fromkeys(frame for part in every for frame in part)
        shared = list(frames)[number - 1 :: count]
        return prepare_frames(shared, self.labels, num_workers, progress, rebuild, on_frame)

    def dataset(
        self, split: str, with_labels: bool = True, exchange_images: bool = False
    ) -> SceneDataset:
        """The frames of a split as items.

        Raises ``InputError`` if the network's image size is not known.
        """
        labels = self.labels if with_labels else None
        return SceneDataset(
            self.frames(split), self._network(), labels, exchange_images=exchange_images
        )

    def training_dataset(self) -> SceneDataset:
        """The frames of an epoch of training, augmented.

        Raises ``InputError`` if the network's image size is not known.
        """
        return SceneDataset(
            self.training_frames(),
            self._network(),
            self.labels,
            self.augmentation,
            self.loading.shuffle_seed,
        )

    def _network(self) -> NetworkInput:
        if self.network is None:
            raise InputError("data.image_size is not set: give the network's [height, width]")
        return self.network

    def train_dataloader(self) -> DataLoader[SceneItem]:
        """The augmented frames of training, in a resumed run from ``position`` on.

        The workers fetch the first batches as soon as the loader is iterated, before Lightning
        sets the epoch, so the sampler has to know where to start.
        """
        loader = self._loader(self.training_dataset(), shuffle=True)
        sampler: Any = loader.sampler
        sampler.start_at(self.position.epoch, self.position.frames)
        return loader

    def val_dataloader(self) -> DataLoader[SceneItem]:
        return self._loader(self.dataset("val"))

    def test_dataloader(self) -> DataLoader[SceneItem]:
        """The labelled frames of ``eval_split``."""
        exchange = self.evaluated.exchange_images
        dataset = self.dataset(self.evaluated.eval_split, exchange_images=exchange)
        if exchange and len(dataset) < 2:
            raise InputError(f"{self.root}: exchange_images=true needs a split of 2 frames or more")
        return self._loader(dataset)

    def predict_dataloader(self) -> DataLoader[SceneItem]:
        """The images of the test split."""
        return self._loader(self.dataset("test", with_labels=False))

    def _loader(self, dataset: SceneDataset, shuffle: bool = False) -> DataLoader[SceneItem]:
        rank, world_size = _rank_and_world_size(self.trainer)
        loading = self.loading
        if loading.num_workers:
            check_shared_memory(self._shared_bytes(), f"data.num_workers={loading.num_workers}")
        return DataLoader(
            dataset,  # pyright: ignore[reportArgumentType]
            batch_size=loading.batch_size,
            sampler=FrameSampler(dataset, shuffle, loading.shuffle_seed, rank, world_size),
            num_workers=loading.num_workers,
            collate_fn=collate,
            pin_memory=loading.pin_memory and torch.cuda.is_available(),
            persistent_workers=loading.num_workers > 0,
            worker_init_fn=_start_worker if loading.num_workers else None,
            # one of its own: iterators would draw from the generator of the network's dropout, and
            # a resumed run makes them at other moments
            generator=torch.Generator().manual_seed(loading.shuffle_seed),
        )

    def _shared_bytes(self) -> int:
        """What the workers share at most: two batches each, of images, labels and objects (a byte
        for each voxel)."""
        height, width = self.network.image_size if self.network else (0, 0)
        frame = 3 * height * width + 2 * math.prod(GRID_SHAPE)
        return 2 * self.loading.num_workers * self.loading.batch_size * frame


def take(kind: type[Part], settings: dict[str, Any]) -> Part:
    """Make a dataclass of those ``settings`` that are its fields, and remove them."""
    fields = dataclasses.fields(kind)  # pyright: ignore[reportArgumentType]
    names = {field.name for field in fields} & settings.keys()
    return kind(**{name: settings.pop(name) for name in names})


def _images(frames: Sequence[Frame]) -> set[str]:
    """The image files of frames, by the path that links lead to."""
    return {os.path.realpath(frame.image) for frame in frames}


def _rank_and_world_size(trainer: lightning.Trainer | None) -> tuple[int, int]:
    if trainer is not None:
        return trainer.global_rank, trainer.world_size
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def _start_worker(worker: int) -> None:
    leave_signals_to_parent()
    use_all_cores()
    cv2.setNumThreads(0)  # the workers are parallel already
    share_batches()
