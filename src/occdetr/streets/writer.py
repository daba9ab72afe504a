"""Writes synthetic streets in SemanticKITTI's layout, so that its reader reads them too.

Every world is drawn from (seed, split, number of the world) alone, and every scan of it from its
number too: the files do not depend on how many processes write them or in what order. The car
drives through a world at 10 scans a second; every fifth scan has voxels, as in the usual download.
"""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from occdetr.data.frames import TRAIN_SEQUENCES, VAL_SEQUENCES
from occdetr.data.semantickitti import write_labels, write_mask
from occdetr.errors import InputError
from occdetr.files import write_atomically, write_image
from occdetr.geometry.kitti import Calibration, write_calibration
from occdetr.streets.drive import ego_pose
from occdetr.streets.moment import SCAN_SECONDS, Camera, World
from occdetr.streets.populate import plan_world
from occdetr.streets.scan import Scan

#: Goes up whenever the same seed would give other files.
GENERATOR_VERSION = 3

#: Voxels exist for every fifth scan, as in the usual download; scans are taken at 10 Hz.
FRAME_STRIDE = 5
MOST_SCANS = 40
#: Metres between the worlds of one sequence in ``poses.txt``.
WORLD_DISTANCE = 1000.0

VOXEL_KINDS = ("label", "invalid", "occluded", "bin")
SETTINGS_FILE = "streets.json"


@dataclass(frozen=True)
class StreetFrame:
    """One scan in memory: RGB picture uint8 [H, W, 3], calibration, the LiDAR's pose in the world
    [4, 4], and the voxel grids."""

    image: np.ndarray
    calibration: Calibration
    pose: np.ndarray
    scan: Scan


@dataclass(frozen=True)
class _Job:
    """One world to write; ``split`` 0 is training, 1 validation."""

    root: Path
    split: int
    index: int
    seed: int
    camera: Camera
    scans: int

    @property
    def sequence(self) -> Path:
        sequences = (TRAIN_SEQUENCES, VAL_SEQUENCES)[self.split]
        return self.root / "sequences" / sequences[self.index % len(sequences)]

    @property
    def numbers(self) -> range:
        """The numbers of this world's scans in its sequence; some may have no files."""
        sequences = (TRAIN_SEQUENCES, VAL_SEQUENCES)[self.split]
        block = frames_per_world(self.scans) * FRAME_STRIDE
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
        return all(
            file.is_file() for scan in range(self.scans) for file in self.files(scan).values()
        )


def frames_per_world(scans: int) -> int:
    """Frames with voxels among a world's scans."""
    return -(-scans // FRAME_STRIDE)


def street_sequences(num_train: int, scans_per_world: int = 1) -> tuple[str, ...]:
    """The training sequences that hold frames when ``num_train`` frames are written."""
    worlds = -(-num_train // frames_per_world(scans_per_world))
    return TRAIN_SEQUENCES[: min(worlds, len(TRAIN_SEQUENCES))]


def make_frame(
    seed: int, split: int, index: int, scan: int = 0, camera: Camera | None = None
) -> StreetFrame:
    """One scan of world number ``index`` of a split (0 train, 1 val)."""
    moment, camera = World(seed, split, index).moment(scan), camera or Camera()
    image = moment.picture(moment.view(camera))
    return StreetFrame(image, camera.calibration, moment.pose, moment.sweep(moment.voxels()))


def write_streets(
    root: Path | str,
    num_train: int,
    num_val: int,
    seed: int = 0,
    num_workers: int = 1,
    camera: Camera | None = None,
    scans_per_world: int = 1,
    progress: bool = True,
) -> int:
    """Write worlds until there are ``num_train`` frames with voxels in sequences 00-07, 09, 10, in
    turn, and ``num_val`` in 08.

    Every world gives ``scans_per_world`` pictures at 10 Hz, and voxels for every fifth. Worlds that
    are complete already are kept, so that an interrupted run goes on and a set can grow. Returns
    the number of worlds written.

    Raises ``InputError`` if a setting is impossible, or if ``root`` holds other data, streets of
    other settings, or more streets than asked for.
    """
    root, camera = Path(root), camera or Camera()
    _check_settings(num_train, num_val, seed, num_workers, camera, scans_per_world)
    _claim_root(root, num_train, num_val, seed, camera, scans_per_world)
    jobs = [
        _Job(root, split, index, seed, camera, scans_per_world)
        for split, count in enumerate((num_train, num_val))
        for index in range(count // frames_per_world(scans_per_world))
    ]
    missing = [job for job in jobs if not job.complete]
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


def _check_settings(
    num_train: int, num_val: int, seed: int, num_workers: int, camera: Camera, scans: int
) -> None:
    for name, value, least in (
        ("num_train", num_train, 0),
        ("num_val", num_val, 0),
        ("seed", seed, 0),
        ("num_workers", num_workers, 0),
        ("image_size", min(camera.image_size), 32),
        ("scans_per_world", scans, 1),
    ):
        if value < least:
            raise InputError(f"synthetic streets: {name}={value}: give {least} or more")
    if scans > MOST_SCANS:
        raise InputError(f"synthetic streets: scans_per_world={scans}: give at most {MOST_SCANS}")
    frames = frames_per_world(scans)
    for name, value in (("num_train", num_train), ("num_val", num_val)):
        if value % frames:
            raise InputError(
                f"synthetic streets: {name}={value}: give a multiple of {frames}, the frames with "
                f"voxels of a world of scans_per_world={scans}"
            )
    fov = camera.horizontal_fov
    if fov is not None and not 10 <= fov <= 150:
        raise InputError(f"synthetic streets: horizontal_fov={fov}: give 10 to 150 degrees")


def _claim_root(
    root: Path, num_train: int, num_val: int, seed: int, camera: Camera, scans: int
) -> None:
    """Note the settings in ``streets.json``, or compare them with those noted there."""
    wanted: dict[str, Any] = {
        "generator_version": GENERATOR_VERSION,
        "seed": seed,
        "image_size": list(camera.image_size),
        "horizontal_fov": camera.horizontal_fov,
        "scans_per_world": scans,
        "num_train": num_train,
        "num_val": num_val,
    }
    path = root / SETTINGS_FILE
    mend = "give another folder or delete this one"
    if not path.is_file():
        if (root / "sequences").exists():
            raise InputError(f"{root}: holds sequences that are not synthetic streets: {mend}")
    else:
        found = _read_settings(path, mend)
        for name in wanted:
            if not name.startswith("num_") and found.get(name) != wanted[name]:
                raise InputError(
                    f"{path}: streets with {name}={found.get(name)}, not {wanted[name]}: {mend}"
                )
        for name in ("num_train", "num_val"):
            if int(found.get(name, 0)) > wanted[name]:
                raise InputError(
                    f"{path}: holds {name}={found[name]} streets, more than {wanted[name]}: {mend}"
                )
    write_atomically(path, (json.dumps(wanted, indent=2) + "\n").encode())


def _read_settings(path: Path, mend: str) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict):
        raise InputError(f"{path}: is not the settings of synthetic streets: {mend}")
    return found


def _write_sequence_files(jobs: list[_Job]) -> None:
    """``calib.txt``, and ``poses.txt`` and ``times.txt`` with a line for every scan's number.

    Poses are those of the left colour camera against the sequence's first, as KITTI's; worlds of
    one sequence lie ``WORLD_DISTANCE`` metres apart.
    """
    of_sequence: dict[Path, list[_Job]] = {}
    for job in jobs:
        of_sequence.setdefault(job.sequence, []).append(job)
    for folder, own in of_sequence.items():
        calibration = own[0].camera.calibration
        write_calibration(folder / "calib.txt", calibration)
        poses = [pose for job in own for pose in _camera_poses(job, calibration)]
        lines = "".join(" ".join(f"{x:.6e}" for x in pose[:3].ravel()) + "\n" for pose in poses)
        times = "".join(f"{number * SCAN_SECONDS:.6e}\n" for number in range(len(poses)))
        write_atomically(folder / "poses.txt", lines.encode())
        write_atomically(folder / "times.txt", times.encode())


def _camera_poses(job: _Job, calibration: Calibration) -> Iterator[np.ndarray]:
    layout, plan = plan_world(np.random.default_rng([job.seed, job.split, job.index, 0]))
    to_camera = calibration.lidar_to_camera
    place = np.eye(4)
    place[0, 3] = WORLD_DISTANCE * (job.numbers.start // len(job.numbers))
    for scan in range(len(job.numbers)):
        pose = ego_pose(layout, plan, layout.speed * scan * SCAN_SECONDS)
        yield to_camera @ place @ pose @ np.linalg.inv(to_camera)


def _write_worlds(jobs: list[_Job], num_workers: int) -> Iterator[None]:
    """Write worlds here or in spawned processes; yields once after each."""
    if num_workers <= 1 or len(jobs) < 2:
        for job in jobs:
            yield _write_world(job)
        return
    _write_world(jobs[0])  # compiles the ray tracer once, into the cache that the others read
    yield
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(num_workers, len(jobs) - 1), mp_context=context) as pool:
        futures = [pool.submit(_write_world, job) for job in jobs[1:]]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _write_world(job: _Job) -> None:
    cv2.setNumThreads(1)  # one process a core
    world = World(job.seed, job.split, job.index)
    for number in range(job.scans):
        files, moment = job.files(number), world.moment(number)
        if "label" in files:
            scan = moment.sweep(moment.voxels())
            write_labels(files["label"], scan.labels)
            masks = {"invalid": scan.invalid, "occluded": scan.occluded, "bin": scan.hits}
            for kind, mask in masks.items():
                write_mask(files[kind], mask)
        write_image(files["image"], moment.picture(moment.view(job.camera)))
