"""Images without labels -> grids and pictures.

``python -m occdetr.predict checkpoint=tiny images=<file|folder|glob> calib=<file>``, or
``camera.fov=90 camera.height=1.6`` in place of ``calib``.
"""

from __future__ import annotations

import re
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import track

from occdetr.api import Camera, Model, Result, load
from occdetr.api.files import SUFFIXES
from occdetr.api.lens_files import is_lens_file
from occdetr.api.model import Prepared
from occdetr.api.viewer import Recording
from occdetr.api.views import make_views
from occdetr.cli import entry as cli
from occdetr.cli.submission import submit
from occdetr.data.ahead import map_ahead
from occdetr.data.find_images import find_images, output_names
from occdetr.data.processes import available_cores
from occdetr.errors import InputError
from occdetr.files import count_pictures, print_error, read_image, write_json
from occdetr.training.checkpoint import UNTRAINED_GRIDS
from occdetr.training.trainer import seed_everything

#: Exit code if some images could not be predicted.
SOME_FAILED = 3
#: Threads that draw and write, which takes longer than the network does on a GPU.
MOST_WRITERS = 8
#: (height, width) of the views of a check: of any network, but small.
ANY_SIZE = (128, 416)
#: Names of files in ``predictions.json`` that are not those of their suffixes.
NAMES = {"png": "picture"}


@cli.entry_point("predict")
def main(config: DictConfig) -> None:
    """Leave the ``files`` of each image and ``predictions.json`` in the run's folder.

    Images that cannot be read are reported and left out; the exit code is then ``SOME_FAILED``, or
    2 if none was predicted.
    """
    seed_everything(config.seed)
    checkpoint = cli.required(config, "checkpoint", "tiny")
    if config.submission is not None:
        submit(config)
        return
    for text in HydraConfig.get().overrides.task:
        if re.match(r"[+~]*(data|trainer|batch_size|description)\b", text):
            raise InputError(f"{text}: only for a submission: leave it out, or give submission=...")
    wanted, folder = str(cli.required(config, "images", "photos/")), cli.run_folder()
    images, skipped = find_images(wanted)
    names, camera = output_names(images, folder), read_camera(config)
    if unknown := sorted(set(config.files) - {suffix[1:] for suffix in SUFFIXES}):
        known = ", ".join(suffix[1:] for suffix in SUFFIXES)
        raise InputError(f"files: {unknown[0]} is not known: choose of {known}")
    if len(images) == 1:  # before the network is built
        check_image(images[0], camera)
    model = load(
        checkpoint,
        config.device,
        config.score_threshold,
        compile=config.compile,
        allow=cli.plain(config.allow),
        merge_doubles=config.merge_doubles,
    )
    if model.trained.stage == "pretrain":
        print(f"note: {checkpoint}: {UNTRAINED_GRIDS}", flush=True)
    if skipped:
        print(f"note: images={wanted}: {skipped}", flush=True)
    jobs = [Job(path, folder / name) for path, name in zip(images, names, strict=True)]
    began, found, failed = time.perf_counter(), [], []
    with recording_of(config.viewer, folder) as recording:
        results = predict_all(model, jobs, camera, list(config.files), recording)
        for entry in track(results, total=len(jobs), description="predicting", transient=True):
            if "error" in entry:
                print_error(entry["error"])
            (failed if "error" in entry else found).append(entry)
    seconds = time.perf_counter() - began
    if not found:
        raise InputError(f"images={wanted}: none of {len(failed)} images could be predicted")
    summary = {
        "checkpoint": str(checkpoint),
        "calib": None if config.calib is None else str(config.calib),
        "camera": cli.plain(config.camera),
        "images": found,
        "failed": failed,
    }
    write_json(folder / "predictions.json", summary)
    print(summarize(found, failed, seconds, folder))
    if failed:
        sys.exit(SOME_FAILED)


def recording_of(viewer: str | None, folder: Path) -> Recording | nullcontext[None]:
    """The file of a viewer, ``predictions.rrd``. Raises ``InputError`` for an unknown one."""
    if viewer is None:
        return nullcontext()
    if viewer != "rerun":
        raise InputError(f"viewer={viewer}: is not known: use rerun or null")
    return Recording(folder / "predictions.rrd")


def read_camera(config: DictConfig) -> Camera:
    """The camera of ``calib`` or of ``camera.fov``, mounted as ``camera`` says.

    Raises ``InputError`` if none is given, or both, or ``camera`` contradicts a calibration of
    KITTI.
    """
    given = {key: value for key, value in cli.plain(config.camera).items() if value is not None}
    fov = given.pop("fov", None)
    if (fov is None) == (config.calib is None):
        both = "calib and camera.fov are both given: keep one"
        none = (
            "calib is not set: give calib=<file> of KITTI, ROS, Kalibr or OpenCV, or "
            "camera.fov=<degrees>, the horizontal field of view"
        )
        raise InputError(none if fov is None else both)
    if fov is not None:
        return Camera.from_fov(fov, **given)
    file = Path(str(config.calib)).expanduser()
    if is_lens_file(file):
        return Camera.from_ros(file, **given)
    if given:
        raise InputError(
            f"camera.{next(iter(given))}: the line Tr of {file} says how the camera is mounted: "
            "leave it out"
        )
    return Camera.from_kitti(file)


@dataclass(frozen=True)
class Job:
    """An image file, and where its results are written, without their suffixes."""

    path: Path
    output: Path


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
    model: Model,
    jobs: Iterable[Job],
    camera: Camera,
    kinds: Sequence[str],
    recording: Recording | None = None,
) -> Iterator[dict[str, Any]]:
    """The entry of each image in ``predictions.json``, in order, when its files are written.

    The network runs in this thread. Meanwhile one thread reads the next images, and others draw
    and write those that are predicted. An image that cannot be used has an entry with its
    ``error``; an error in writing is raised.
    """
    loaded = map_ahead(partial(read, model=model, camera=camera), jobs)
    predicted = map(partial(predict_image, model), loaded)
    predicted = map(partial(record, recording), predicted)
    threads = min(available_cores(), MOST_WRITERS)
    return map_ahead(partial(write, kinds=kinds), predicted, threads=threads)


def check_image(path: Path, camera: Camera) -> None:
    """Raises ``InputError`` if an image is broken or does not fit the camera."""
    image = read_image(path)
    try:
        make_views(image, camera, ANY_SIZE)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def read(job: Job, model: Model, camera: Camera) -> Loaded | Failed:
    """Read an image and make the network's views of it."""
    try:
        image = read_image(job.path)
    except InputError as error:
        return Failed(job, one_line(error))
    if (number := count_pictures(job.path)) > 1:
        warnings.warn(f"{job.path}: has {number} pictures, only the first is used", stacklevel=2)
    try:
        return Loaded(job, model.prepare(image, camera, job.path.name))
    except InputError as error:
        return Failed(job, f"{job.path}: {one_line(error)}")


def predict_image(model: Model, loaded: Loaded | Failed) -> Predicted | Failed:
    """Run the network on an image."""
    if isinstance(loaded, Failed):
        return loaded
    try:
        return Predicted(loaded.job, model.run(loaded.prepared))
    except InputError as error:
        return Failed(loaded.job, one_line(error))


def record(recording: Recording | None, done: Predicted | Failed) -> Predicted | Failed:
    """Add a result to the recording, in order."""
    if recording is not None and isinstance(done, Predicted):
        recording.add(done.result)
    return done


def write(done: Predicted | Failed, kinds: Sequence[str]) -> dict[str, Any]:
    """Write the files of an image; returns its entry in ``predictions.json``."""
    job = done.job
    if isinstance(done, Failed):
        return {"image": str(job.path), "error": done.error}
    name = job.output.name
    files = {kind: job.output.with_name(f"{name}.{kind}") for kind in kinds}
    for file in files.values():
        done.result.save(file)
    named = {NAMES.get(kind, kind): file.name for kind, file in files.items()}
    return {"image": str(job.path), **named, "objects": describe(done.result)}


def one_line(error: InputError) -> str:
    return " ".join(str(error).splitlines())


def summarize(
    found: Sequence[dict[str, Any]], failed: Sequence[Any], seconds: float, folder: Path
) -> str:
    """What was done, in one line; ``seconds`` is the time of all images together."""
    count = sum(len(entry["objects"]) for entry in found)
    of = f" of {len(found) + len(failed)}" if failed else ""
    images = f"{len(found)}{of} image{'' if len(found) == 1 and not failed else 's'}"
    return (
        f"done: {images}, {count} objects, {len(found) / seconds:.2f} frames/s; "
        f"their files and predictions.json in {cli.shown(folder)}"
        + (f"; {len(failed)} failed, listed in predictions.json" if failed else "")
    )


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


if __name__ == "__main__":
    main()
