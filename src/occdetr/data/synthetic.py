"""Writes synthetic streets in SemanticKITTI's layout, so that its reader reads them too.

Every frame is a world of its own, drawn from (seed, split, number of the world) alone: the files
do not depend on how many processes write them or in what order. The worlds are there to try the
whole road without a download and to train small models; they are no substitute for real streets.
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

from occdetr.data.semantickitti import (
    TRAIN_SEQUENCES,
    VAL_SEQUENCES,
    Calibration,
    write_atomically,
    write_calibration,
    write_image,
    write_labels,
    write_mask,
)
from occdetr.data.streets.populate import make_street
from occdetr.data.streets.render import render_street
from occdetr.data.streets.scan import Scan, scan_street
from occdetr.errors import InputError
from occdetr.geometry.camera import scale_projection

#: Goes up whenever the same seed would give other files.
GENERATOR_VERSION = 1

#: Frames are numbered as in the usual download, every fifth scan.
FRAME_STRIDE = 5

KITTI_IMAGE_SIZE = (370, 1226)
VOXEL_KINDS = ("label", "invalid", "occluded", "bin")
SETTINGS_FILE = "streets.json"

# P2 and Tr of KITTI odometry's sequences 04-10.
_PROJECTION = (
    (707.0912, 0.0, 601.8873, 46.88783),
    (0.0, 707.0912, 183.1104, 0.1178601),
    (0.0, 0.0, 1.0, 0.006203223),
)
_LIDAR_TO_CAMERA = (
    (-0.001857739385241, -0.9999659513510, -0.008039975204516, -0.004784029760483),
    (-0.006481465826011, 0.008051860151134, -0.9999466081774, -0.07337429464231),
    (0.9999773098287, -0.001805528627661, -0.006496203536139, -0.3339968064433),
    (0.0, 0.0, 0.0, 1.0),
)


@dataclass(frozen=True)
class StreetFrame:
    """One frame in memory: RGB picture uint8 [H, W, 3], calibration and voxel grids."""

    image: np.ndarray
    calibration: Calibration
    scan: Scan


@dataclass(frozen=True)
class _Job:
    """One frame to write; ``split`` 0 is training, 1 validation."""

    root: Path
    split: int
    index: int
    seed: int
    image_size: tuple[int, int]

    @property
    def files(self) -> dict[str, Path]:
        sequences = (TRAIN_SEQUENCES, VAL_SEQUENCES)[self.split]
        sequence = self.root / "sequences" / sequences[self.index % len(sequences)]
        name = f"{self.index // len(sequences) * FRAME_STRIDE:06d}"
        voxels = {kind: sequence / "voxels" / f"{name}.{kind}" for kind in VOXEL_KINDS}
        return {"image": sequence / "image_2" / f"{name}.png", **voxels}


def street_sequences(num_train: int) -> tuple[str, ...]:
    """The training sequences that hold frames when ``num_train`` worlds are written."""
    return TRAIN_SEQUENCES[: min(num_train, len(TRAIN_SEQUENCES))]


def kitti_calibration(image_size: tuple[int, int] = KITTI_IMAGE_SIZE) -> Calibration:
    """KITTI's camera, its intrinsics scaled to pictures of ``image_size`` (height, width)."""
    height, width = image_size
    scale_x, scale_y = width / KITTI_IMAGE_SIZE[1], height / KITTI_IMAGE_SIZE[0]
    projection = scale_projection(np.array(_PROJECTION), scale_x, scale_y)
    return Calibration(projection, np.array(_LIDAR_TO_CAMERA))


def make_frame(
    seed: int, split: int, index: int, image_size: tuple[int, int] = KITTI_IMAGE_SIZE
) -> StreetFrame:
    """World number ``index`` of a split (0 train, 1 val) with its picture and voxel grids.

    The world and its scans do not depend on the image size.
    """
    world_rng, scan_rng, image_rng = (
        np.random.default_rng([seed, split, index, part]) for part in range(3)
    )
    world, layout = make_street(world_rng)
    calibration = kitti_calibration(image_size)
    scan = scan_street(world, layout, scan_rng)
    camera = (calibration.projection, calibration.lidar_to_camera)
    image = render_street(world, layout, *camera, image_size, image_rng)
    return StreetFrame(image, calibration, scan)


def write_streets(
    root: Path | str,
    num_train: int,
    num_val: int,
    seed: int = 0,
    num_workers: int = 1,
    image_size: tuple[int, int] = KITTI_IMAGE_SIZE,
    progress: bool = True,
) -> int:
    """Write ``num_train`` worlds to sequences 00-07, 09, 10 in turn and ``num_val`` to 08.

    Frames that are complete already are kept, so that an interrupted run goes on and a set can
    grow. ``image_size`` is (height, width). Returns the number of frames written.

    Raises ``InputError`` if a setting is impossible, or if ``root`` holds other data, streets of
    other settings, or more streets than asked for.
    """
    root, image_size = Path(root), (int(image_size[0]), int(image_size[1]))
    _check_numbers(num_train, num_val, seed, num_workers, image_size)
    _claim_root(root, num_train, num_val, seed, image_size)
    jobs = [
        _Job(root, split, index, seed, image_size)
        for split, count in enumerate((num_train, num_val))
        for index in range(count)
    ]
    _write_sequence_files(jobs, image_size)
    missing = [job for job in jobs if not all(file.is_file() for file in job.files.values())]
    columns = (
        TextColumn("[progress.description]{task.description}"),
        *(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()),
    )
    with Progress(*columns, disable=not (progress and missing)) as bar:
        task = bar.add_task("writing synthetic streets", total=len(missing))
        for _ in _write_frames(missing, num_workers):
            bar.advance(task)
    return len(missing)


def _check_numbers(
    num_train: int, num_val: int, seed: int, num_workers: int, image_size: tuple[int, int]
) -> None:
    for name, value, least in (
        ("num_train", num_train, 0),
        ("num_val", num_val, 0),
        ("seed", seed, 0),
        ("num_workers", num_workers, 0),
        ("image_size", min(image_size), 32),
    ):
        if value < least:
            raise InputError(f"synthetic streets: {name}={value}: give {least} or more")


def _claim_root(
    root: Path, num_train: int, num_val: int, seed: int, image_size: tuple[int, int]
) -> None:
    """Note the settings in ``streets.json``, or compare them with those noted there."""
    wanted: dict[str, Any] = {
        "generator_version": GENERATOR_VERSION,
        "seed": seed,
        "image_size": list(image_size),
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
        for name in ("generator_version", "seed", "image_size"):
            if found.get(name) != wanted[name]:
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


def _write_sequence_files(jobs: list[_Job], image_size: tuple[int, int]) -> None:
    """``calib.txt``, and ``poses.txt`` and ``times.txt`` with a line for every scan.

    Each frame is another world, so the poses only say: straight on, a metre a scan.
    """
    last: dict[Path, int] = {}
    for job in jobs:
        image = job.files["image"]
        folder = image.parent.parent
        last[folder] = max(last.get(folder, 0), int(image.stem))
    for folder, number in last.items():
        write_calibration(folder / "calib.txt", kitti_calibration(image_size))
        poses = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {scan}\n" for scan in range(number + 1))
        times = "".join(f"{scan / 10:.6e}\n" for scan in range(number + 1))
        write_atomically(folder / "poses.txt", poses.encode())
        write_atomically(folder / "times.txt", times.encode())


def _write_frames(jobs: list[_Job], num_workers: int) -> Iterator[None]:
    """Write frames here or in spawned processes; yields once after each."""
    if num_workers <= 1 or len(jobs) < 2:
        for job in jobs:
            yield _write_frame(job)
        return
    _write_frame(jobs[0])  # compiles the ray caster once, into the cache that the others read
    yield
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(num_workers, len(jobs) - 1), mp_context=context) as pool:
        futures = [pool.submit(_write_frame, job) for job in jobs[1:]]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _write_frame(job: _Job) -> None:
    cv2.setNumThreads(1)  # one process a core
    frame, files = make_frame(job.seed, job.split, job.index, job.image_size), job.files
    scan = frame.scan
    write_labels(files["label"], scan.labels)
    for kind, mask in (("invalid", scan.invalid), ("occluded", scan.occluded), ("bin", scan.hits)):
        write_mask(files[kind], mask)
    write_image(files["image"], frame.image)
