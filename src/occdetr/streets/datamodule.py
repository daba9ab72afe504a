"""Synthetic streets as a LightningDataModule, written if they are missing."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from occdetr.data.cache import CACHE_FOLDER
from occdetr.data.datamodule import DatasetFolder, SceneDataModule, take
from occdetr.data.frames import VAL_SEQUENCES
from occdetr.data.objects import ObjectSettings
from occdetr.data.processes import available_cores
from occdetr.errors import PROCESSES, Range, check_range, check_ranges
from occdetr.streets.settings import StreetSettings
from occdetr.streets.writer import GENERATOR_VERSION, write_streets

FRAMES = Range(1, 200_000)  # of a split: names of files have six digits


class SyntheticDataModule(SceneDataModule):
    """Synthetic streets, written to ``root`` by ``write_workers`` processes (0: one for each core)
    if they are missing.

    ``settings`` are the fields of ``StreetSettings`` and the settings of ``SceneDataModule``. The
    sequences are those that the streets fill; object labels are cached by the generator's version.
    Raises ``InputError`` also if a split would be empty.
    """

    parts = (StreetSettings, *SceneDataModule.parts)

    def __init__(
        self, objects: ObjectSettings | None = None, write_workers: int = 0, **settings: Any
    ) -> None:
        streets, folder = take(StreetSettings, settings), take(DatasetFolder, settings)
        check_ranges("data", streets, num_train=FRAMES, num_val=FRAMES)
        check_range("data.write_workers", write_workers, PROCESSES)
        cache_dir = folder.cache_dir
        if cache_dir is None:
            cache_dir = Path(folder.root) / CACHE_FOLDER / f"streets-v{GENERATOR_VERSION}"
        filled = dataclasses.replace(
            folder,
            train_sequences=streets.train_sequences,
            test_sequences=VAL_SEQUENCES,
            cache_dir=cache_dir,
        )
        super().__init__(objects, **vars(filled), **settings)
        self.streets = streets
        self.write_workers = write_workers or available_cores()

    def summary(self, split: str) -> str:
        """The number of frames, where they are, and the generator's version and seed."""
        made = f"synthetic streets, generator version {GENERATOR_VERSION}"
        return f"{super().summary(split)} ({made}, seed {self.streets.seed})"

    def prepare_data(self) -> None:
        """Write what is missing; Lightning calls it once per node."""
        write_streets(self.root, self.streets, self.write_workers)
