"""Object labels of many frames, made in parallel processes before anything needs them."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import signal
import statistics
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from occdetr.data.cache import (
    build_objects,
    cache_file,
    inputs_key,
    load_objects,
    remove_stale_files,
    save_objects,
    settings_folder,
)
from occdetr.data.frames import Frame
from occdetr.data.objects import ObjectSettings, extract_objects
from occdetr.data.stopwatch import Stopwatch
from occdetr.errors import InputError
from occdetr.geometry.kitti import Calibration
from occdetr.geometry.rois import match_rois
from occdetr.geometry.voxels import GRID_SHAPE

#: What the time of a frame goes into, and which of it makes the labels, file reading apart.
PARTS = ("reading", "clustering", "visibility", "boxes", "matching", "writing")
LABEL_PARTS = ("clustering", "visibility", "boxes")


@dataclass(frozen=True)
class PreparedFrame:
    """One frame: whether its objects were made now, how many, and the seconds of each part."""

    built: bool
    objects: int
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class PreparedFrames:
    """What ``prepare_frames`` did, in ``seconds`` of time on the wall."""

    frames: Sequence[PreparedFrame]
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

    def median_seconds(self, parts: Sequence[str]) -> float | None:
        """Seconds that ``parts`` together took of a frame: median of the frames built; None if
        there are none."""
        built = [frame.seconds for frame in self.frames if frame.built]
        sums = [sum(seconds.get(part, 0.0) for part in parts) for seconds in built]
        return statistics.median(sums) if sums else None


def prepare_frames(
    frames: Sequence[Frame],
    settings: ObjectSettings,
    cache_dir: Path | str,
    num_workers: int = 1,
    progress: bool = True,
    rebuild: bool = False,
    rois: Float32[NDArray, "token 4"] | None = None,
    on_frame: Callable[[PreparedFrame], None] | None = None,
) -> PreparedFrames:
    """Make the objects of all frames that the cache lacks, in parallel processes.

    May be stopped at any moment and started again: what is there is kept, or with ``rebuild`` made
    anew and replaced. ``progress`` shows a bar; ``on_frame`` is called after each frame. With
    ``rois`` early matching, which is not kept, is timed beside the rest. Raises ``InputError`` if a
    file is missing or broken, the cache cannot be written, or a process was killed.
    """
    began = time.perf_counter()
    done: list[PreparedFrame] = []
    if not settings.classes:
        return PreparedFrames([PreparedFrame(False, 0, {})] * len(frames), 0.0)
    remove_stale_files(settings_folder(settings, cache_dir))
    columns = (
        TextColumn("[progress.description]{task.description}"),
        *(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()),
    )
    prepare = functools.partial(_prepare, settings, Path(cache_dir), rebuild, rois)
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task("object labels", total=len(frames))
        for frame in _run(prepare, frames, num_workers):
            done.append(frame)
            bar.advance(task)
            if on_frame is not None:
                on_frame(frame)
    return PreparedFrames(done, time.perf_counter() - began)


def _run(
    prepare: Callable[[Frame], PreparedFrame], frames: Sequence[Frame], num_workers: int
) -> Iterator[PreparedFrame]:
    """Work here or in spawned processes; yields after each frame."""
    if num_workers <= 1 or len(frames) < 2:
        yield from map(prepare, frames)
        return
    yield prepare(frames[0])  # compiles once, into the cache of numba that the others read
    context = multiprocessing.get_context("spawn")
    count = min(num_workers, len(frames) - 1)
    with ProcessPoolExecutor(count, context, initializer=_end_with_parent) as pool:
        try:
            with _interrupts_held_back():
                futures = [pool.submit(prepare, frame) for frame in frames[1:]]
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            raise InputError(
                f"one of {count} processes was killed, for lack of memory perhaps: "
                "run it again with fewer workers, it goes on from there"
            ) from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Ctrl-C comes when this ends; never to processes started in it, which inherit the mask. So
    they end their frames, and it is their parent that stops."""
    resource_tracker.ensure_running()  # when it starts, it clears the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """Without this, workers whose parent was killed would wait for jobs forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _prepare(
    settings: ObjectSettings,
    cache_dir: Path,
    rebuild: bool,
    rois: Float32[NDArray, "token 4"] | None,
    frame: Frame,
) -> PreparedFrame:
    path, key = cache_file(frame, settings, cache_dir), inputs_key(frame)
    objects = None if rebuild else load_objects(path, key)
    if objects is not None:
        return PreparedFrame(False, len(objects), {})
    _compile()
    watch = Stopwatch()
    objects = build_objects(frame, settings, watch)
    if rois is not None:
        match_rois(objects.boxes_cxcywh, rois)
        watch.lap("matching")
    try:
        save_objects(path, objects, key)
    except OSError as error:
        raise InputError(
            f"{cache_dir}: cannot write object labels ({error.strerror}): set data.cache_dir"
        ) from None
    watch.lap("writing")
    return PreparedFrame(True, len(objects), watch.seconds)


@functools.cache
def _compile() -> None:
    """Let numba compile, or load what it has compiled before, once in a process and off the clock:
    a box ahead of a camera that looks along x passes through all of it."""
    labels = np.zeros(GRID_SHAPE, dtype=np.uint8)
    labels[50:60, 123:133, 5:15] = ObjectSettings().classes[0]
    projection = np.array([[32.0, 0.0, 32.0, 0.0], [0.0, 32.0, 16.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    lidar_to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    extract_objects(labels, Calibration(projection, lidar_to_camera), (32, 64), ObjectSettings())
