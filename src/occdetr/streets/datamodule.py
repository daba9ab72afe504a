"""Synthetic streets as a LightningDataModule, written when they are not there yet."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from occdetr.data.datamodule import SceneDataModule
from occdetr.data.frames import VAL_SEQUENCES
from occdetr.streets.moment import KITTI_IMAGE_SIZE, Camera
from occdetr.streets.writer import GENERATOR_VERSION, street_sequences, write_streets


class SyntheticDataModule(SceneDataModule):
    """Synthetic streets, written to ``root`` if they are not there yet.

    ``num_train``, ``num_val``: frames with voxels of each split; their worlds never share a seed.
    ``seed``, ``street_image_size`` (height, width), ``horizontal_fov`` (degrees; None is KITTI's
    camera) and ``scans_per_world`` (pictures at 10 Hz of each world, voxels for every fifth) decide
    what is written, and ``write_workers`` processes write it (0: one for each core).
    ``scene``: the other arguments of ``SceneDataModule``, all but the sequences.
    """

    def __init__(
        self,
        num_train: int,
        num_val: int,
        root: str | Path = "data/synthetic",
        seed: int = 0,
        street_image_size: Sequence[int] = KITTI_IMAGE_SIZE,
        horizontal_fov: float | None = None,
        scans_per_world: int = 1,
        write_workers: int = 0,
        **scene: Any,
    ) -> None:
        super().__init__(
            root,
            train_sequences=street_sequences(num_train, max(scans_per_world, 1)),
            test_sequences=VAL_SEQUENCES,
            **scene,
        )
        if scene.get("cache_dir") is None:
            self.cache_dir = self.cache_dir / f"streets-v{GENERATOR_VERSION}"
        self.num_train, self.num_val = int(num_train), int(num_val)
        self.seed, self.scans_per_world = int(seed), int(scans_per_world)
        height, width = street_image_size
        self.camera = Camera((int(height), int(width)), horizontal_fov)
        self.write_workers = int(write_workers) or os.cpu_count() or 1

    def summary(self, split: str) -> str:
        """One line: how many frames there are, of which generator and seed, where."""
        made = f"synthetic streets, generator version {GENERATOR_VERSION}, seed {self.seed}"
        return f"{super().summary(split)} ({made})"

    def prepare_data(self) -> None:
        """Write what is missing; Lightning calls it once per node."""
        write_streets(
            self.root,
            self.num_train,
            self.num_val,
            self.seed,
            self.write_workers,
            self.camera,
            self.scans_per_world,
        )
