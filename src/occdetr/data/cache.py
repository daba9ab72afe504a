"""Object labels on disk: one file per frame, so that they are computed once.

A file is named after its frame and lies in a folder named after the settings, so that partitions do
not push each other out. It ends with a seal over its content and the state of the frame's input
files; a file whose seal does not fit, as it is truncated, damaged or made from other files, is made
again. Writing is atomic: any number of processes may do it at once, and be killed at any moment.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import time
import warnings
from pathlib import Path

import numpy as np

from occdetr.data.frames import Frame
from occdetr.data.objects import (
    OBJECTS_VERSION,
    ObjectSettings,
    SceneObjects,
    empty_objects,
    extract_objects,
)
from occdetr.data.semantickitti import read_labels
from occdetr.data.stopwatch import Stopwatch
from occdetr.errors import InputError
from occdetr.files import read_image, write_atomically
from occdetr.geometry.kitti import read_calibration

CACHE_FOLDER = ".occdetr_cache"  # below the dataset's root, unless another place is given
STALE_AFTER = 3600.0  # seconds; a file is written in milliseconds

_SEAL_BYTES = 32


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


def settings_folder(settings: ObjectSettings, cache_dir: Path | str) -> Path:
    """Where the objects that ``settings`` give are kept, in a folder for each sequence."""
    return Path(cache_dir) / settings_key(settings)


def cache_file(frame: Frame, settings: ObjectSettings, cache_dir: Path | str) -> Path:
    """Where the objects of a frame are kept."""
    return settings_folder(settings, cache_dir) / frame.sequence / f"{frame.name}.npz"


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
            _remove_stale_once(settings_folder(settings, cache_dir))
        except OSError as error:
            warnings.warn(f"{cache_dir}: object labels are not kept ({error})", stacklevel=2)
    return objects


def build_objects(
    frame: Frame, settings: ObjectSettings, watch: Stopwatch | None = None
) -> SceneObjects:
    """The objects of a frame, from its files.

    ``watch`` gets the lap "reading" and those of ``extract_objects``.
    """
    watch = watch or Stopwatch()
    calibration = read_calibration(frame.calibration)
    size, labels = image_size_of(frame.image), read_labels(frame)
    watch.lap("reading")
    return extract_objects(labels, calibration, size, settings, watch)


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
    """Write objects, sealed with the key of what they were made from, all or nothing."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **objects.arrays())
    content = buffer.getvalue()
    write_atomically(path, content + _seal(content, key))


def load_objects(path: Path, key: str) -> SceneObjects | None:
    """Read objects; None if there is no file, or one that is damaged or made from other files."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    content = data[:-_SEAL_BYTES]
    if data[-_SEAL_BYTES:] != _seal(content, key):
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return SceneObjects(**{field.name: file[field.name] for field in _FIELDS})


_FIELDS = dataclasses.fields(SceneObjects)


def _seal(content: bytes, key: str) -> bytes:
    # zip's own checksums leave its headers out: a flipped bit there could change a shape or a type
    return hashlib.sha256(key.encode() + content).digest()


def remove_stale_files(folder: Path) -> None:
    """Remove the temporary files that killed processes have left in a settings' folder.

    Nothing reads them. Young ones stay: another process may be writing them at this moment.
    """
    oldest = time.time() - STALE_AFTER
    for path in folder.glob("*/.*.npz.*.tmp"):  # as write_atomically names them
        with contextlib.suppress(FileNotFoundError):  # another process was faster
            if path.stat().st_mtime < oldest:
                path.unlink()


_remove_stale_once = functools.cache(remove_stale_files)  # in each process, for each folder
