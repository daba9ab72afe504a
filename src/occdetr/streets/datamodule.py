"""Synthetic streets as a LightningDataModule, written if they are missing."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any, ClassVar

from occdetr.data.cache import CACHE_FOLDER
from occdetr.data.datamodule import DatasetFolder, SceneDataModule
from occdetr.data.frames import VAL_SEQUENCES
from occdetr.streets.settings import StreetSettings
from occdetr.streets.writer import GENERATOR_VERSION, write_streets


class SyntheticDataModule(SceneDataModule):
    """Synthetic streets in ``folder.root``, written there if they are missing.

    ``write_workers`` processes write them (0: one for each core). The sequences of ``folder`` are
    replaced by those that ``streets`` fill; object labels are cached by the generator's version.
    ``parts`` are the other arguments of ``SceneDataModule``.
    """

    SETTINGS_GROUPS: ClassVar[dict[str, type]] = {
        **SceneDataModule.SETTINGS_GROUPS,
        "streets": StreetSettings,
    }

    def __init__(
        self, folder: DatasetFolder, streets: StreetSettings, write_workers: int = 0, **parts: Any
    ) -> None:
        cache_dir = folder.cache_dir
        if cache_dir is None:
            cache_dir = Path(folder.root) / CACHE_FOLDER / f"streets-v{GENERATOR_VERSION}"
        own = dataclasses.replace(
            folder,
            train_sequences=streets.train_sequences,
            test_sequences=VAL_SEQUENCES,
            cache_dir=cache_dir,
        )
        super().__init__(own, **parts)
        self.streets = streets
        self.write_workers = write_workers or os.cpu_count() or 1

    def summary(self, split: str) -> str:
        """The number of frames, where they are, and the generator's version and seed."""
        made = f"synthetic streets, generator version {GENERATOR_VERSION}"
        return f"{super().summary(split)} ({made}, seed {self.streets.seed})"

    def prepare_data(self) -> None:
        """Write what is missing; Lightning calls it once per node."""
        write_streets(self.root, self.streets, self.write_workers)
