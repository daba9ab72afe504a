"""Object labels of many frames, made in advance in parallel processes."""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from occdetr.data.cache import (
    ObjectCache,
    build_objects,
    inputs_key,
    load_objects,
    remove_stale_files,
    save_objects,
)
from occdetr.data.frames import Frame
from occdetr.data.objects import ObjectSettings, extract_objects
from occdetr.data.parallel import in_processes
from occdetr.data.stopwatch import Stopwatch
from occdetr.errors import InputError
from occdetr.geometry.camera import Camera
from occdetr.geometry.voxels import GRID_SHAPE

#: The steps of a frame that are timed, and those of them that make labels from arrays.
STEPS = ("reading", "clustering", "visibility", "boxes", "writing")
LABEL_STEPS = ("clustering", "visibility", "boxes")


@dataclass(frozen=True)
class FrameResult:
    """One prepared frame: whether its labels were made now, its number of objects, and the seconds
    of each step."""

    built: bool
    objects: int
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class PreparationResult:
    """The result of ``prepare_frames``; ``seconds`` is wall-clock time."""

    frames: Sequence[FrameResult]
    seconds: float

    @property
    def built(self) -> int:
        return sum(frame.built for frame in self.frames)

    @property
    def reused(self) -> int:
        return len(self.frames) - self.built

    @property
    def objects(self) -> int:
        return sum(frame.objects for frame in self.frames)

    def median_seconds(self, steps: Sequence[str]) -> float | None:
        """Median over the frames built of the seconds that ``steps`` took together; None if no
        frame was built."""
        built = [frame.seconds for frame in self.frames if frame.built]
        sums = [sum(seconds.get(step, 0.0) for step in steps) for seconds in built]
        return statistics.median(sums) if sums else None


def prepare_frames(
    frames: Sequence[Frame],
    cache: ObjectCache,
    num_workers: int = 1,
    progress: bool = True,
    rebuild: bool = False,
    on_frame: Callable[[FrameResult], None] | None = None,
) -> PreparationResult:
    """Make and cache the object labels of all frames that are not cached, in parallel processes.

    It can be interrupted and started again at any time. ``rebuild`` makes cached labels again.
    ``progress`` shows a bar, and ``on_frame`` is called after each frame. Raises ``InputError`` if
    a file is missing or broken, the cache cannot be written, or a process was killed.
    """
    began = time.perf_counter()
    done: list[FrameResult] = []
    if not cache.settings.classes:
        return PreparationResult([FrameResult(False, 0, {})] * len(frames), 0.0)
    remove_stale_files(cache.folder)
    columns = (
        TextColumn("[progress.description]{task.description}"),
        *(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()),
    )
    prepare = functools.partial(_prepare, cache, rebuild)
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task("object labels", total=len(frames))
        for frame in _run(prepare, frames, num_workers):
            done.append(frame)
            bar.advance(task)
            if on_frame is not None:
                on_frame(frame)
    return PreparationResult(done, time.perf_counter() - began)


def _run(
    prepare: Callable[[Frame], FrameResult], frames: Sequence[Frame], num_workers: int
) -> Iterator[FrameResult]:
    """Prepare frames in this process or in spawned ones; yields after each frame."""
    if num_workers <= 1 or len(frames) < 2:
        yield from map(prepare, frames)
        return
    yield prepare(frames[0])  # compiles into numba's cache, which the other processes read
    yield from in_processes(prepare, frames[1:], min(num_workers, len(frames) - 1))


def _prepare(cache: ObjectCache, rebuild: bool, frame: Frame) -> FrameResult:
    path, key = cache.file(frame), inputs_key(frame)
    objects = None if rebuild else load_objects(path, key)
    if objects is not None:
        return FrameResult(False, len(objects), {})
    _compile()
    watch = Stopwatch()
    objects = build_objects(frame, cache.settings, watch)
    try:
        save_objects(path, objects, key)
    except OSError as error:
        raise InputError(
            f"{cache.root}: cannot write object labels ({error.strerror}): set data.cache_dir"
        ) from None
    watch.lap("writing")
    return FrameResult(True, len(objects), watch.seconds)


@functools.cache
def _compile() -> None:
    """Let numba compile or load its functions once in each process, outside the measured time, on a
    box in front of a camera that looks along x."""
    labels = np.zeros(GRID_SHAPE, dtype=np.uint8)
    labels[50:60, 123:133, 5:15] = ObjectSettings().classes[0]
    projection = np.array([[32.0, 0.0, 32.0, 0.0], [0.0, 32.0, 16.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    lidar_to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    extract_objects(labels, Camera(projection, lidar_to_camera, (32, 64)), ObjectSettings())
