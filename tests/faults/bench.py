"""The small training that is disturbed, and the undisturbed one that it is compared with."""

from __future__ import annotations

import json
import re
import shutil
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from faults.processes import Run, start, start_ranks, wait_all

#: Seconds after which a run counts as hanging.
PATIENCE = 300.0
#: Streets: odd numbers, so that batches and ranks do not come out even.
STREETS = ("data.num_train=7", "data.num_val=3", "data.street_image_size=[96,320]")
NETWORK = (
    *("model=tiny", "image_size=[32,104]", "attention.hidden_dim=32", "attention.num_heads=2"),
    *("attention.feedforward_dim=16", "model.encoder.in_channels=[8,8,16,16]"),
    "model.backbone._target_=faults.small_backbone.SmallBackbone",
    *("~model.backbone.variant", "~model.backbone.freeze_norm", "~model.backbone.freeze_stem"),
    *("model.detector.num_layers=1", "model.detector.selection.num_queries=20"),
    "model.encoder.dropout=0.1",  # random numbers in the network continue too
    *("model.slots.num_slots=4", "model.occupancy_decoder.background.kept=[64,96,128]"),
    *("model.occupancy_decoder.background.refine_dim=8", "model.occupancy_decoder.sight_dim=8"),
    *("model.mask_head.num_layers=1", "model.mask_head.voxel_dim=8"),
)
SCHEDULE = ("scheduler.warmup_steps=3", "logger=none")
#: An epoch has 4 steps, on 2 ranks 2, so that checkpoints fall into the middle and the end of one.
CALLBACKS = ("callbacks=[steps,checkpoint]", "callbacks.checkpoint.every_steps=3")
#: The content of ``metrics.json`` that must not depend on kills.
FIGURES = ("steps", "epochs", "best", "metrics", "validations")


@dataclass(frozen=True)
class Training:
    """A stage on some ranks, each with some loader workers."""

    stage: str
    ranks: int = 1
    workers: int = 0

    @property
    def name(self) -> str:
        ranks = "1 rank" if self.ranks == 1 else f"{self.ranks} ranks"
        return f"stage={self.stage}, {ranks}, {self.workers} workers"


@dataclass(frozen=True)
class Outcome:
    """What a finished training leaves, of which nothing may depend on kills; and its seconds."""

    weights: dict[str, torch.Tensor]
    optimizer: Any
    figures: dict[str, Any]
    seconds: float = 0.0

    def differences(self, other: Outcome) -> list[str]:
        """The parts that are not equal to the last bit."""
        wrong = []
        for name in ("weights", "optimizer"):
            mine, theirs = _leaves(getattr(self, name)), _leaves(getattr(other, name))
            unequal = [key for key in mine.keys() | theirs.keys() if not _same(mine, theirs, key)]
            if unequal:
                wrong.append(f"{len(unequal)} of {len(mine)} values of the {name}")
        wrong += [key for key in self.figures if self.figures[key] != other.figures[key]]
        return wrong


class Bench:
    """A folder with streets, their labels and a pretraining, and the runs that are made from them.

    ``data``: settings of synthetic streets, which are written if they are missing.
    """

    def __init__(self, folder: Path, data: Sequence[str] = (), epochs: int = 5) -> None:
        self.folder = folder
        self.data = data or (*STREETS, f"data.root={folder / 'data'}")
        self.epochs = epochs
        self._made: dict[Any, Any] = {}
        self._locks: dict[Any, threading.Lock] = {}
        self._lock = threading.Lock()

    def prepare(self) -> None:
        """Write the streets and their labels."""
        given = [*self.streets, *self.outputs("prepare")]
        self.succeed(start("prepare", given, self.log("prepare")))

    @property
    def streets(self) -> list[str]:
        return ["data=synthetic", *self.data, "data.write_workers=1"]

    @property
    def pretraining(self) -> Path:
        """A checkpoint to start ``stage=full`` from."""
        return self._once("pretraining", self._pretrain)

    def _pretrain(self) -> Path:
        run = self.folder / "pretraining"
        remove(run)  # of an earlier use of the folder
        given = [*self.settings(Training("pretrain")), f"hydra.run.dir={run}"]
        self.succeed(start("train", given, self.log("pretraining")))
        return run / "last.ckpt"

    def settings(self, training: Training) -> list[str]:
        trainer = "trainer=cpu" if training.ranks == 1 else "trainer=ddp"
        given = [f"stage={training.stage}", *NETWORK, *self.streets, trainer]
        given += [f"trainer.max_epochs={self.epochs}", *SCHEDULE, *CALLBACKS]
        given += [f"data.num_workers={training.workers}"]
        if training.ranks > 1:
            given += ["trainer.accelerator=cpu", f"trainer.devices={training.ranks}"]
        return given

    def start(
        self,
        training: Training,
        place: Path,
        log: str,
        before: Callable[[], object] | None = None,
    ) -> list[Run]:
        """Start or continue a training whose runs lie below ``place``."""
        resume = continuation(place)
        given = [*self.settings(training), f"outputs={place / 'outputs'}", resume]
        if training.stage == "full" and resume == "resume=allow":
            given.append(f"init_from={self.pretraining}")
        return start_ranks(training.ranks, given, place / "logs" / log, before)

    def reference(self, training: Training) -> Outcome:
        """What an undisturbed run leaves."""
        return self._once(training, lambda: self._train(training))

    def prepared(self, kind: str) -> tuple[dict[str, bytes], float]:
        """The "labels" or "streets" that an undisturbed preparation writes, and its seconds."""
        return self._once(kind, lambda: self._prepare(kind))

    def _train(self, training: Training) -> Outcome:
        place = self.folder / "references" / file_name(training.name)
        remove(place)
        began = time.monotonic()
        codes = wait_all(self.start(training, place, "run"), PATIENCE)
        if any(codes):
            raise RuntimeError(f"{place / 'logs'}: the undisturbed run ended with {codes}")
        return outcome(place, time.monotonic() - began)

    def _prepare(self, kind: str) -> tuple[dict[str, bytes], float]:
        place = self.folder / "references" / kind
        remove(place)
        given = [*self.preparation(kind, place, 1), *self.outputs("prepare")]
        began = time.monotonic()
        self.succeed(start("prepare", given, self.log(kind)))
        return contents(place), time.monotonic() - began

    def preparation(self, kind: str, place: Path, workers: int) -> list[str]:
        """Settings of ``prepare`` that write labels of the bench's streets, or streets, there."""
        given = [*self.streets, f"workers={workers}"]
        if kind == "labels":
            return [*given, f"data.cache_dir={place}"]
        return [*given, f"data.root={place}", f"data.write_workers={workers}"]

    def _once(self, key: Any, make: Callable[[], Any]) -> Any:
        """What ``make`` returned for ``key``; threads that ask for it meanwhile wait."""
        with self._lock:
            lock = self._locks.setdefault(key, threading.Lock())
        with lock:
            if key not in self._made:
                self._made[key] = make()
        return self._made[key]

    def outputs(self, name: str) -> list[str]:
        return [f"outputs={self.folder / name}"]

    def log(self, name: str) -> Path:
        return self.folder / "logs" / name

    @staticmethod
    def succeed(run: Run) -> None:
        code = run.wait(PATIENCE)
        if code != 0:
            raise RuntimeError(f"{run.err}: ended with {code}: {run.err.read_text()[-2000:]}")


def continuation(place: Path) -> str:
    """``resume=auto`` if there is a checkpoint, else ``resume=allow``."""
    return "resume=auto" if checkpoints(place) else "resume=allow"


def checkpoints(place: Path) -> list[Path]:
    """Every run's last checkpoint, the oldest first."""
    return sorted(place.glob("outputs/*/*/last.ckpt"), key=lambda path: path.stat().st_mtime_ns)


def outcome(place: Path, seconds: float = 0.0) -> Outcome:
    """What the last run below ``place`` has left."""
    last = checkpoints(place)[-1]
    content = torch.load(last, weights_only=True)
    summary = json.loads((last.parent / "metrics.json").read_text())
    figures = {
        name: summary[name] for name in ("steps", "epochs", "best", "metrics", "validations")
    }
    state = {name: content[name] for name in ("optimizer_states", "lr_schedulers")}
    return Outcome(content["state_dict"], state, figures, seconds)


def contents(folder: Path) -> dict[str, bytes]:
    """Every whole file of a folder by its path, but for labels beside streets: they depend on the
    times at which the streets were written."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".tmp")
    own = {str(path.relative_to(folder)): path for path in files}
    return {name: path.read_bytes() for name, path in own.items() if ".occdetr_cache" not in name}


def temporary_files(place: Path) -> list[Path]:
    return [path for path in place.rglob("*.tmp") if path.is_file()]


def file_name(name: str) -> str:
    """``name`` without what the grammar of settings or a shell would read in its own way, and with
    a checksum, so that two names stay apart."""
    return f"{re.sub('[^a-zA-Z0-9]+', '-', name)[:80]}-{zlib.crc32(name.encode()):08x}"


def remove(place: Path) -> None:
    shutil.rmtree(place, ignore_errors=True)


def _leaves(value: Any, name: str = "") -> dict[str, Any]:
    """The tensors and numbers of nested dictionaries and lists by their place."""
    if isinstance(value, dict):
        parts: Sequence[tuple[Any, Any]] = list(value.items())
    elif isinstance(value, (list, tuple)):
        parts = list(enumerate(value))
    else:
        return {name: value}
    return {k: v for key, part in parts for k, v in _leaves(part, f"{name}/{key}").items()}


def _same(mine: dict[str, Any], theirs: dict[str, Any], key: str) -> bool:
    if key not in mine or key not in theirs:
        return False
    a, b = mine[key], theirs[key]
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
