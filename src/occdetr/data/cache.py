"""Object labels on disk: one file per frame, so that they are computed once.

A file is named after its frame and lies in a folder named after the settings, so that several
partitions can be cached side by side. It ends with a checksum of its content and of the state of
the frame's input files. A file whose checksum does not fit, because it is truncated, damaged or
made from other input files, is made again. Writes are atomic: any number of processes may write
at the same time and be killed at any moment.
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
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from occdetr.data.frames import Frame
from occdetr.data.images import read_picture_camera
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
from occdetr.files import write_atomically

CACHE_FOLDER = ".occdetr_cache"  # below the dataset's root, unless another place is given
STALE_AFTER = 3600.0  # seconds; a file is written in milliseconds

_CHECKSUM_BYTES = 32


@dataclass(frozen=True)
class ObjectCache:
    """The object labels that ``settings`` give, kept below ``root``; None: not kept on disk."""

    settings: ObjectSettings
    root: Path | None = None

    @property
    def folder(self) -> Path:
        """The folder of these settings, with one folder for each sequence."""
        if self.root is None:
            raise ValueError("a cache without a root has no folder")
        return Path(self.root) / settings_key(self.settings)

    def file(self, frame: Frame) -> Path:
        """Where the objects of a frame are kept."""
        sequence = "-".join(filter(None, (frame.dataset, frame.sequence)))
        return self.folder / sequence / f"{frame.name}.npz"

    def load_or_build(self, frame: Frame) -> SceneObjects:
        """The objects of a frame: read if they are cached, else made and cached.

        If the folder cannot be written, they are not kept, with a warning. Raises ``InputError`` if
        an input file is missing or broken.
        """
        if not self.settings.classes:
            return empty_objects()
        if self.root is None:
            return build_objects(frame, self.settings)
        path, key = self.file(frame), inputs_key(frame)
        objects = load_objects(path, key)
        if objects is None:
            objects = build_objects(frame, self.settings)
            try:
                save_objects(path, objects, key)
                _remove_stale_once(self.folder)
            except OSError as error:
                warnings.warn(f"{self.root}: object labels are not kept ({error})", stacklevel=2)
        return objects


def settings_key(settings: ObjectSettings) -> str:
    """A hash of everything, besides the input files, on which the objects depend."""
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
    """A hash of size and modification time of each of the frame's files, not of their paths."""
    files = [frame.image, frame.calibration, frame.voxel_file("label"), frame.voxel_file("invalid")]
    try:
        states = [(state.st_size, state.st_mtime_ns) for state in (file.stat() for file in files)]
    except FileNotFoundError as error:
        raise InputError(f"{error.filename}: file is missing: check the dataset folder") from None
    return hashlib.sha256(json.dumps(states).encode()).hexdigest()[:16]


def build_objects(
    frame: Frame, settings: ObjectSettings, watch: Stopwatch | None = None
) -> SceneObjects:
    """The objects of a frame, made from its files.

    ``watch`` gets the lap "reading" and those of ``extract_objects``.
    """
    watch = watch or Stopwatch()
    camera = read_picture_camera(frame.image, frame.calibration)
    labels = read_labels(frame)
    watch.lap("reading")
    return extract_objects(labels, camera, settings, watch)


def save_objects(path: Path, objects: SceneObjects, key: str) -> None:
    """Write objects with a checksum that includes the ``key`` of their input files, atomically."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **objects.arrays())
    content = buffer.getvalue()
    write_atomically(path, content + _checksum(content, key))


def load_objects(path: Path, key: str) -> SceneObjects | None:
    """Read objects; None if the file is missing, damaged or made from other input files."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    content = data[:-_CHECKSUM_BYTES]
    if data[-_CHECKSUM_BYTES:] != _checksum(content, key):
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return SceneObjects(**{field.name: file[field.name] for field in _FIELDS})


_FIELDS = dataclasses.fields(SceneObjects)


def _checksum(content: bytes, key: str) -> bytes:
    # zip's own checksums do not cover its headers, where a flipped bit could change shape or type
    return hashlib.sha256(key.encode() + content).digest()


def remove_stale_files(folder: Path) -> None:
    """Remove the temporary files that killed processes have left in an ``ObjectCache.folder``.

    Files younger than ``STALE_AFTER`` stay: another process may be writing them.
    """
    oldest = time.time() - STALE_AFTER
    for path in folder.glob("*/.*.npz.*.tmp"):  # as write_atomically names them
        with contextlib.suppress(FileNotFoundError):  # another process was faster
            if path.stat().st_mtime < oldest:
                path.unlink()


_remove_stale_once = functools.cache(remove_stale_files)  # once for each process and folder
