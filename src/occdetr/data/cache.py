"""Object labels on disk: one file per frame, so that they are computed once.

A file is named after its frame and lies in a folder named after the settings, so that partitions do
not push each other out. Inside is a key of the frame's input files; a file with another key, a
truncated or a damaged one is made again. Writing is atomic: any number of processes may do it at
once, and be killed at any moment.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import multiprocessing
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from occdetr.data.objects import (
    OBJECTS_VERSION,
    ObjectSettings,
    SceneObjects,
    empty_objects,
    extract_objects,
)
from occdetr.data.semantickitti import (
    Frame,
    read_calibration,
    read_image,
    read_labels,
    write_atomically,
)
from occdetr.errors import InputError

CACHE_FOLDER = ".occdetr_cache"  # below the dataset's root, unless another place is given


@dataclass(frozen=True)
class PreparedFrames:
    """What ``prepare_frames`` did: frames made and found, objects in all of them, seconds."""

    built: int
    reused: int
    objects: int
    seconds: float


def settings_key(settings: ObjectSettings) -> str:
    """A name for all that decides, beside the files, what the objects are."""
    content = {
        "version": OBJECTS_VERSION,
        "classes": sorted(settings.classes),
        "distance": settings.distance_table().tolist(),
        "min_voxels": settings.min_voxels_table().tolist(),
        "ray_stride": settings.ray_stride,
        "min_visible_pixels": settings.min_visible_pixels,
    }
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def inputs_key(frame: Frame) -> str:
    """A key of the frame's files: size and time of change of each, not where they lie."""
    files = [frame.image, frame.calibration, frame.voxel_file("label"), frame.voxel_file("invalid")]
    try:
        states = [(state.st_size, state.st_mtime_ns) for state in (file.stat() for file in files)]
    except FileNotFoundError as error:
        raise InputError(f"{error.filename}: file is missing: check the dataset folder") from None
    return hashlib.sha256(json.dumps(states).encode()).hexdigest()[:16]


def cache_file(frame: Frame, settings: ObjectSettings, cache_dir: Path | str) -> Path:
    """Where the objects of a frame are kept."""
    return Path(cache_dir) / settings_key(settings) / frame.sequence / f"{frame.name}.npz"


def load_or_build(
    frame: Frame, settings: ObjectSettings, cache_dir: Path | str | None
) -> SceneObjects:
    """The objects of a frame, from the cache if it has them, else made and kept there.

    Without a ``cache_dir`` they are made each time; so they are, with a warning, if it cannot be
    written to. Raises ``InputError`` if an input file is missing or broken.
    """
    if not settings.classes:
        return empty_objects()
    if cache_dir is None:
        return build_objects(frame, settings)
    path, key = cache_file(frame, settings, cache_dir), inputs_key(frame)
    objects = load_objects(path, key)
    if objects is None:
        objects = build_objects(frame, settings)
        try:
            save_objects(path, objects, key)
        except OSError as error:
            warnings.warn(f"{cache_dir}: object labels are not kept ({error})", stacklevel=2)
    return objects


def build_objects(frame: Frame, settings: ObjectSettings) -> SceneObjects:
    """The objects of a frame, from its files."""
    calibration = read_calibration(frame.calibration)
    size = image_size_of(frame.image)
    return extract_objects(read_labels(frame), calibration, size, settings)


def image_size_of(path: Path) -> tuple[int, int]:
    """(height, width) of a picture; of a PNG without decoding it."""
    try:
        with path.open("rb") as file:
            head = file.read(24)
    except OSError:
        head = b""
    if len(head) == 24 and head.startswith(b"\x89PNG\r\n\x1a\n") and head[12:16] == b"IHDR":
        return int.from_bytes(head[20:24], "big"), int.from_bytes(head[16:20], "big")
    height, width = read_image(path).shape[:2]
    return height, width


def save_objects(path: Path, objects: SceneObjects, key: str) -> None:
    """Write objects and the key of what they were made from, all or nothing."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, key=np.array(key), **objects.arrays())
    write_atomically(path, buffer.getvalue())


def load_objects(path: Path, key: str) -> SceneObjects | None:
    """Read objects; None if there is no file, or one that is damaged or made from other files."""
    names = [field.name for field in dataclasses.fields(SceneObjects)]
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["key"]) != key:
                return None
            objects = SceneObjects(**{name: file[name] for name in names})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
    return objects if _is_whole(objects) else None


def _is_whole(objects: SceneObjects) -> bool:
    """Whether the arrays have the types and shapes that belong together."""
    count, voxels = len(objects.classes), len(objects.voxel_object)
    return all(
        array.dtype == expected.dtype
        and array.shape == ((voxels if "voxel" in name else count), *expected.shape[1:])
        for (name, array), expected in zip(
            objects.arrays().items(), empty_objects().arrays().values(), strict=True
        )
    )


def prepare_frames(
    frames: Sequence[Frame],
    settings: ObjectSettings,
    cache_dir: Path | str,
    num_workers: int = 1,
    progress: bool = True,
    on_frame: Callable[[int, int], None] | None = None,
) -> PreparedFrames:
    """Make the objects of all frames that the cache lacks, in parallel processes.

    May be stopped at any moment and started again: what is there is kept. ``progress`` shows a bar;
    ``on_frame(done, total)`` is called after each frame. Raises ``InputError`` if a file is missing
    or broken, or the cache cannot be written.
    """
    began = time.perf_counter()
    if not settings.classes:
        return PreparedFrames(0, len(frames), 0, 0.0)
    columns = (
        TextColumn("[progress.description]{task.description}"),
        *(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()),
    )
    built = objects = 0
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task("object labels", total=len(frames))
        jobs = [(frame, settings, Path(cache_dir)) for frame in frames]
        for done, (is_new, count) in enumerate(_run(jobs, num_workers), start=1):
            built, objects = built + is_new, objects + count
            bar.advance(task)
            if on_frame is not None:
                on_frame(done, len(frames))
    return PreparedFrames(built, len(frames) - built, objects, time.perf_counter() - began)


_Job = tuple[Frame, ObjectSettings, Path]


def _run(jobs: list[_Job], num_workers: int) -> Iterator[tuple[bool, int]]:
    """Work here or in spawned processes; yields (made anew, number of objects) for each frame."""
    if num_workers <= 1 or len(jobs) < 2:
        yield from map(_prepare, jobs)
        return
    yield _prepare(jobs[0])  # compiles once, into the cache of numba that the others read
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(num_workers, len(jobs) - 1), mp_context=context) as pool:
        futures = [pool.submit(_prepare, job) for job in jobs[1:]]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _prepare(job: _Job) -> tuple[bool, int]:
    cv2.setNumThreads(1)  # one process a core
    frame, settings, cache_dir = job
    path, key = cache_file(frame, settings, cache_dir), inputs_key(frame)
    objects = load_objects(path, key)
    if objects is not None:
        return False, len(objects)
    objects = build_objects(frame, settings)
    try:
        save_objects(path, objects, key)
    except OSError as error:
        raise InputError(
            f"{cache_dir}: cannot write object labels ({error.strerror}): set data.cache_dir"
        ) from None
    return True, len(objects)
