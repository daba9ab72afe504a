"""Writes synthetic streets in SemanticKITTI's layout.

A world depends only on (seed, split, number of the world), and a scan only on its world and its
number, so the files do not depend on the number of processes and their order. The car drives
through a world at 10 scans per second; every fifth scan has voxels, as in SemanticKITTI's download.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from occdetr.data.frames import TRAIN_SEQUENCES, VAL_SEQUENCES
from occdetr.data.parallel import in_processes
from occdetr.data.semantickitti import write_labels, write_mask
from occdetr.errors import InputError
from occdetr.files import write_if_changed, write_image, write_json
from occdetr.geometry.camera import Camera
from occdetr.geometry.kitti import kitti_camera, write_calibration
from occdetr.streets.drive import ego_pose
from occdetr.streets.populate import plan_world
from occdetr.streets.scan import Scan
from occdetr.streets.settings import FRAME_STRIDE, StreetSettings
from occdetr.streets.world import SCAN_SECONDS, World, world_tilt

#: Increased whenever the same seed gives other files.
GENERATOR_VERSION = 3

#: Metres between the worlds of one sequence in ``poses.txt``.
WORLD_DISTANCE = 1000.0

VOXEL_KINDS = ("label", "invalid", "occluded", "bin")
SETTINGS_FILE = "streets.json"
_REMEDY = "set data.root to another folder, or delete this one"


@dataclass(frozen=True)
class StreetFrame:
    """One scan in memory: RGB image, its camera, the LiDAR's pose in the world, voxel grids."""

    image: UInt8[np.ndarray, "height width 3"]
    camera: Camera
    pose: Float[np.ndarray, "4 4"]
    scan: Scan


@dataclass(frozen=True)
class _Job:
    """One world to write; ``split`` 0 is training, 1 validation."""

    root: Path
    split: int
    index: int
    settings: StreetSettings

    @property
    def sequence(self) -> Path:
        sequences = (TRAIN_SEQUENCES, VAL_SEQUENCES)[self.split]
        return self.root / "sequences" / sequences[self.index % len(sequences)]

    @property
    def camera(self) -> Camera:
        own = None if self.split else self.index % len(TRAIN_SEQUENCES)
        return self.settings.camera(own)

    @property
    def numbers(self) -> range:
        """The numbers of this world's scans in its sequence; the last ones may have no files."""
        sequences = (TRAIN_SEQUENCES, VAL_SEQUENCES)[self.split]
        block = self.settings.frames_per_world * FRAME_STRIDE
        start = self.index // len(sequences) * block
        return range(start, start + block)

    def files(self, scan: int) -> dict[str, Path]:
        """Where the files of a scan go, by kind."""
        name = f"{self.numbers[scan]:06d}"
        kinds = VOXEL_KINDS if scan % FRAME_STRIDE == 0 else ()
        voxels = {kind: self.sequence / "voxels" / f"{name}.{kind}" for kind in kinds}
        return {"image": self.sequence / "image_2" / f"{name}.png", **voxels}

    @property
    def complete(self) -> bool:
        scans = range(self.settings.scans_per_world)
        return all(file.is_file() for scan in scans for file in self.files(scan).values())


def make_frame(
    seed: int, split: int, index: int, scan: int = 0, camera: Camera | None = None
) -> StreetFrame:
    """One scan of world number ``index`` of a split (0 train, 1 val); default: KITTI's camera."""
    snapshot, camera = World(seed, split, index).snapshot(scan), camera or kitti_camera()
    image = snapshot.picture(snapshot.view(camera))
    return StreetFrame(image, camera, snapshot.pose, snapshot.sweep(snapshot.voxels()))


def write_streets(
    root: Path | str, settings: StreetSettings, num_workers: int = 1, progress: bool = True
) -> int:
    """Write the worlds that are missing; returns their number.

    Worlds go to the training sequences (00-07, 09, 10) in turn, and to 08 for validation. Worlds
    that are complete are kept, so an interrupted run can be continued and a set can grow.

    Raises ``InputError`` if ``root`` holds other data, streets of other settings, or more streets
    than asked for.
    """
    root = Path(root)
    if num_workers < 0:
        raise InputError(f"data.write_workers={num_workers}: give 0 or more")
    _claim_root(root, settings)
    jobs = [
        _Job(root, split, index, settings)
        for split, count in enumerate((settings.num_train, settings.num_val))
        for index in range(count // settings.frames_per_world)
    ]
    missing = [job for job in jobs if not job.complete]
    if missing and progress:
        count = f"{len(missing)} of {len(jobs)} synthetic worlds are missing"
        print(f"note: {root}: {count}: writing them", flush=True)
    columns = (
        TextColumn("[progress.description]{task.description}"),
        *(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()),
    )
    with Progress(*columns, disable=not (progress and missing)) as bar:
        task = bar.add_task("writing synthetic streets", total=len(missing))
        for _ in _write_worlds(missing, num_workers):
            bar.advance(task)
    _write_sequence_files(jobs)
    return len(missing)


def _claim_root(root: Path, settings: StreetSettings) -> None:
    """Write the settings to ``streets.json``, or compare them with those there."""
    wanted: dict[str, Any] = {
        "generator_version": GENERATOR_VERSION,
        "seed": settings.seed,
        "image_size": list(settings.street_image_size),
        "horizontal_fov": settings.horizontal_fov,
        "mounting": settings.mounting(),
        "scans_per_world": settings.scans_per_world,
        "num_train": settings.num_train,
        "num_val": settings.num_val,
    }
    path = root / SETTINGS_FILE
    if not path.is_file():
        if (root / "sequences").exists():
            raise InputError(f"{root}: holds sequences that are not synthetic streets: {_REMEDY}")
    else:
        found = _read_settings(path)
        for name in wanted:
            if not name.startswith("num_") and found.get(name) != wanted[name]:
                raise InputError(
                    f"{path}: has streets with {name}={found.get(name)}, not {wanted[name]}: "
                    f"{_REMEDY}"
                )
        for name in ("num_train", "num_val"):
            if int(found.get(name, 0)) > wanted[name]:
                raise InputError(
                    f"{path}: has {name}={found[name]} streets, more than {wanted[name]}: {_REMEDY}"
                )
    write_json(path, wanted)


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or not all(
        isinstance(found.get(name, 0), int) for name in ("num_train", "num_val")
    ):
        raise InputError(f"{path}: does not hold the settings of synthetic streets: {_REMEDY}")
    return found


def _write_sequence_files(jobs: list[_Job]) -> None:
    """Write ``calib.txt``, and ``poses.txt`` and ``times.txt`` with a line for each scan number.

    Poses are those of the left colour camera relative to the sequence's first, as in KITTI; the
    worlds of one sequence are ``WORLD_DISTANCE`` metres apart.
    """
    of_sequence: dict[Path, list[_Job]] = {}
    for job in jobs:
        of_sequence.setdefault(job.sequence, []).append(job)
    for folder, own in of_sequence.items():
        camera = own[0].camera
        write_calibration(folder / "calib.txt", camera)
        poses = [pose for job in own for pose in _camera_poses(job, camera)]
        lines = "".join(" ".join(f"{x:.6e}" for x in pose[:3].ravel()) + "\n" for pose in poses)
        times = "".join(f"{number * SCAN_SECONDS:.6e}\n" for number in range(len(poses)))
        write_if_changed(folder / "poses.txt", lines.encode())
        write_if_changed(folder / "times.txt", times.encode())


def _camera_poses(job: _Job, camera: Camera) -> Iterator[np.ndarray]:
    key = job.settings.seed, job.split, job.index
    layout, plan = plan_world(np.random.default_rng([*key, 0]))
    tilt = world_tilt(*key) if job.settings.sensor_tilt else np.eye(4)
    to_camera = np.asarray(camera.lidar_to_camera)
    place = np.eye(4)
    place[0, 3] = WORLD_DISTANCE * (job.numbers.start // len(job.numbers))
    for scan in range(len(job.numbers)):
        pose = ego_pose(layout, plan, layout.speed * scan * SCAN_SECONDS)
        own = np.linalg.inv(tilt) @ place @ pose @ tilt
        yield to_camera @ own @ np.linalg.inv(to_camera)


def _write_worlds(jobs: list[_Job], num_workers: int) -> Iterator[None]:
    """Write worlds in this process or in spawned ones; yields after each."""
    if num_workers <= 1 or len(jobs) < 2:
        for job in jobs:
            yield _write_world(job)
        return
    _write_world(jobs[0])  # compiles into numba's cache, which the other processes read
    yield
    yield from in_processes(_write_world, jobs[1:], min(num_workers, len(jobs) - 1))


def _write_world(job: _Job) -> None:
    cv2.setNumThreads(1)  # one process for each core
    key = job.settings.seed, job.split, job.index
    world, camera = World(*key, tilted=job.settings.sensor_tilt), job.camera
    for number in range(job.settings.scans_per_world):
        files, snapshot = job.files(number), world.snapshot(number)
        if "label" in files:
            scan = snapshot.sweep(snapshot.voxels())
            write_labels(files["label"], scan.labels)
            masks = {"invalid": scan.invalid, "occluded": scan.occluded, "bin": scan.hits}
            for kind, mask in masks.items():
                write_mask(files[kind], mask)
        write_image(files["image"], snapshot.picture(snapshot.view(camera)))
