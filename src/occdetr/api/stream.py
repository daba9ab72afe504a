"""Many images, one after the other: read, predicted, and their files written, side by side."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from occdetr.api.camera import Camera
from occdetr.api.model import Model, Prepared, Result
from occdetr.api.video import Image, Video, VideoFile
from occdetr.api.viewer import Recording
from occdetr.data.ahead import map_ahead
from occdetr.data.processes import available_cores
from occdetr.drawing.panels import video_panel
from occdetr.errors import InputError
from occdetr.files import count_pictures, read_image

#: Threads that draw and write, which takes longer than the network does on a GPU.
MOST_WRITERS = 8
#: Names of files in ``predictions.json`` that are not those of their suffixes.
NAMES = {"png": "picture"}


@dataclass(frozen=True)
class Job:
    """An image, and where its results are written, without their suffixes.

    ``path``: its file, or the video that ``image`` is the ``frame`` of, at ``seconds``.
    """

    path: Path
    output: Path
    image: Image | None = None
    frame: int | None = None
    seconds: float | None = None

    @property
    def source(self) -> dict[str, Any]:
        """Which image it is, for ``predictions.json``."""
        of_video = {} if self.frame is None else {"frame": self.frame, "seconds": self.seconds}
        return {"image": str(self.path), **of_video}

    @property
    def name(self) -> str:
        """For titles and messages."""
        return self.path.name if self.frame is None else f"{self.path.name}, frame {self.frame}"


def video_jobs(video: Video, output: Path) -> Iterator[Job]:
    """A job for each frame of a video; its files are ``output`` and the frame's number."""
    for number, image in video:
        own = output.with_name(f"{output.name}_{number:06d}")
        yield Job(video.path, own, image, number, round(number / video.rate, 3))


@dataclass(frozen=True)
class Outputs:
    """What is written: files of these ``kinds`` (suffixes) for each image, and of all together a
    recording and a video."""

    kinds: Sequence[str]
    recording: Recording | None = None
    video: VideoFile | None = None


@dataclass(frozen=True)
class Loaded:
    """An image, and the network's views of it."""

    job: Job
    prepared: Prepared


@dataclass(frozen=True)
class Predicted:
    """What the network has found in an image."""

    job: Job
    result: Result


@dataclass(frozen=True)
class Failed:
    """An image that is left out, and the error's line."""

    job: Job
    error: str


def predict_all(
    model: Model, jobs: Iterable[Job], camera: Camera, outputs: Outputs
) -> Iterator[dict[str, Any]]:
    """The entry of each image in ``predictions.json``, in order, when its files are written.

    The network runs in this thread. Meanwhile one thread reads the next images, and others draw
    and write those that are predicted. An image that cannot be used has an entry with its
    ``error``; an error in writing is raised.
    """
    loaded = map_ahead(partial(read, model=model, camera=camera), jobs)
    predicted = map(partial(predict_image, model), loaded)
    predicted = map(partial(record, outputs.recording), predicted)
    threads = min(available_cores(), MOST_WRITERS)
    for written in map_ahead(partial(write, outputs=outputs), predicted, threads=threads):
        if outputs.video is not None and written.panel is not None:
            outputs.video.add(written.panel)
        yield written.entry


def read(job: Job, model: Model, camera: Camera) -> Loaded | Failed:
    """Read an image and make the network's views of it."""
    image = job.image
    try:
        if image is None:
            image = read_image(job.path)
    except InputError as error:
        return Failed(job, one_line(error))
    if job.image is None and (number := count_pictures(job.path)) > 1:
        warnings.warn(f"{job.path}: has {number} pictures, only the first is used", stacklevel=2)
    try:
        return Loaded(job, model.prepare(image, camera, job.name))
    except InputError as error:
        return Failed(job, one_line(f"{job.path}: {error}"))


def predict_image(model: Model, loaded: Loaded | Failed) -> Predicted | Failed:
    """Run the network on an image."""
    if isinstance(loaded, Failed):
        return loaded
    try:
        return Predicted(loaded.job, model.run(loaded.prepared))
    except InputError as error:
        return Failed(loaded.job, one_line(f"{loaded.job.path}: {error}"))


def record(recording: Recording | None, done: Predicted | Failed) -> Predicted | Failed:
    """Add a result to the recording, in order."""
    if recording is not None and isinstance(done, Predicted):
        recording.add(done.result)
    return done


@dataclass(frozen=True)
class Written:
    """An image's entry in ``predictions.json``, and its picture for the video."""

    entry: dict[str, Any]
    panel: Image | None = None


def write(done: Predicted | Failed, outputs: Outputs) -> Written:
    """Write the files of an image, and draw its picture for the video if there is one."""
    job = done.job
    if isinstance(done, Failed):
        return Written({**job.source, "error": done.error})
    result, name = done.result, job.output.name
    files = {kind: job.output.with_name(f"{name}.{kind}") for kind in outputs.kinds}
    for file in files.values():
        result.save(file)
    named = {NAMES.get(kind, kind): file.name for kind, file in files.items()}
    entry = {**job.source, **named, "objects": describe(result)}
    if outputs.video is None:
        return Written(entry)
    objects = result.boxes, result.classes, result.scores
    return Written(entry, video_panel(result.image, *objects, result.grid))


def one_line(error: InputError | str) -> str:
    return " ".join(str(error).splitlines())


def describe(result: Result) -> list[dict[str, Any]]:
    """The objects of an image for ``predictions.json``: 2D boxes in pixels of the image, 3D boxes
    in metres in the grid frame."""
    columns = (result.class_names, result.scores, result.boxes, result.boxes3d)
    return [
        {
            "class": name,
            "score": round(float(score), 4),
            "box_xyxy": [round(float(value), 1) for value in box],
            "box3d_center": [round(float(value), 2) for value in box3d[:3]],
            "box3d_size": [round(float(value), 2) for value in box3d[3:]],
        }
        for name, score, box, box3d in zip(*columns, strict=True)
    ]
