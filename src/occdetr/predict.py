"""Images without labels -> grids and pictures.

``python -m occdetr.predict checkpoint=... images=<file|folder|glob> calib=<calib.txt>``
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich.progress import track

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.data.ahead import map_ahead
from occdetr.data.dataset import SceneItem, collate, make_item
from occdetr.data.find_images import find_images, output_names
from occdetr.data.images import read_picture, resize_picture
from occdetr.data.processes import available_cores
from occdetr.data.semantickitti import write_labels
from occdetr.drawing.panels import scene_panel
from occdetr.errors import InputError
from occdetr.files import count_pictures, print_error, write_image, write_json
from occdetr.geometry.kitti import read_calibration
from occdetr.models.compilation import compile_network
from occdetr.models.inference import Prediction, predict
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.checkpoint import UNTRAINED_GRIDS, restore_model
from occdetr.training.device import choose_device
from occdetr.training.trainer import seed_everything

#: Exit code if some images could not be predicted.
SOME_FAILED = 3
#: Threads that draw and write, which takes longer than the network does on a GPU.
MOST_WRITERS = 8


@cli.entry_point("predict")
def main(config: DictConfig) -> None:
    """Leave a ``.label`` and a ``.png`` per image and ``predictions.json`` in the run's folder.

    Images that cannot be read are reported and left out; the exit code is then ``SOME_FAILED``, or
    2 if none was predicted.
    """
    seed_everything(config.seed)
    checkpoint = cli.required(config, "checkpoint", "outputs/full/<run>/best.ckpt")
    wanted, folder = str(cli.required(config, "images", "photos/")), cli.run_folder()
    images, skipped = find_images(wanted)
    names = output_names(images, folder)
    calib = Path(str(cli.required(config, "calib", "sequences/08/calib.txt"))).expanduser()
    read_calibration(calib)  # reports a wrong one before the network is built
    if len(images) == 1:
        read_picture(images[0], calib)
    device = choose_device(config.device)
    model, trained = restore_model(checkpoint, cli.plain(config.allow))
    model.to(device)
    if config.compile:
        compile_network(model, device)
    if trained.stage == "pretrain":
        print(f"note: {checkpoint}: {UNTRAINED_GRIDS}", flush=True)
    if config.score_threshold is not None:
        model.fusion.score_threshold = float(config.score_threshold)
    if skipped:
        print(f"note: images={wanted}: {skipped}", flush=True)
    jobs = [Job(path, folder / name) for path, name in zip(images, names, strict=True)]
    began, found, failed = time.perf_counter(), [], []
    results = predict_all(model, jobs, calib)
    for entry in track(results, total=len(jobs), description="predicting", transient=True):
        if "error" in entry:
            print_error(entry["error"])
        (failed if "error" in entry else found).append(entry)
    seconds = time.perf_counter() - began
    if not found:
        raise InputError(f"images={wanted}: none of {len(failed)} images could be predicted")
    summary = {
        "checkpoint": str(checkpoint),
        "calib": str(calib),
        "images": found,
        "failed": failed,
    }
    write_json(folder / "predictions.json", summary)
    print(summarize(found, failed, seconds, folder))
    if failed:
        sys.exit(SOME_FAILED)


@dataclass(frozen=True)
class Job:
    """An image file, and where its grid and its picture are written, without their suffixes."""

    path: Path
    output: Path


@dataclass(frozen=True)
class Loaded:
    """An image (RGB, in its own size), and the network's input."""

    job: Job
    image: NDArray[np.uint8]
    item: SceneItem


@dataclass(frozen=True)
class Predicted:
    """An image and what the network has found in it."""

    job: Job
    image: NDArray[np.uint8]
    prediction: Prediction


@dataclass(frozen=True)
class Failed:
    """An image that is left out, and the error's line."""

    job: Job
    error: str


def predict_all(model: OccupancyDETR, jobs: Iterable[Job], calib: Path) -> Iterator[dict[str, Any]]:
    """The entry of each image in ``predictions.json``, in order, when its files are written.

    The network runs in this thread. Meanwhile one thread reads the next images, and others draw
    and write those that are predicted. An image that cannot be used has an entry with its
    ``error``; an error in writing is raised.
    """
    loaded = map_ahead(partial(load, calib=calib, image_size=model.image_size), jobs)
    predicted = map(partial(predict_picture, model), loaded)
    return map_ahead(write, predicted, threads=min(available_cores(), MOST_WRITERS))


def load(job: Job, calib: Path, image_size: tuple[int, int]) -> Loaded | Failed:
    """Read an image for a network of this image size."""
    try:
        image, camera = read_picture(job.path, calib)
    except InputError as error:
        return Failed(job, one_line(error))
    if (number := count_pictures(job.path)) > 1:
        warnings.warn(f"{job.path}: has {number} pictures, only the first is used", stacklevel=2)
    item = make_item(*resize_picture(image, camera, image_size), 0, job.path.stem)
    return Loaded(job, image, item)


def predict_picture(model: OccupancyDETR, loaded: Loaded | Failed) -> Predicted | Failed:
    """Run the network on an image."""
    if isinstance(loaded, Failed):
        return loaded
    batch = collate([loaded.item]).to(next(model.parameters()).device)
    try:
        (prediction,) = predict(model, batch, [(loaded.image.shape[0], loaded.image.shape[1])])
    except InputError as error:
        return Failed(loaded.job, one_line(error))
    return Predicted(loaded.job, loaded.image, prediction)


def write(done: Predicted | Failed) -> dict[str, Any]:
    """Write the grid and the picture of an image; returns its entry in ``predictions.json``."""
    job = done.job
    if isinstance(done, Failed):
        return {"image": str(job.path), "error": done.error}
    found, name = done.prediction, job.output.name
    files = {kind: job.output.with_name(f"{name}.{kind}") for kind in ("label", "png")}
    objects = (found.boxes_xyxy, found.classes, found.scores)
    title = f"{name}{job.path.suffix}"
    write_labels(files["label"], found.grid)
    write_image(files["png"], scene_panel(done.image, *objects, None, found.grid, title=title))
    return {
        "image": str(job.path),
        "label": files["label"].name,
        "picture": files["png"].name,
        "objects": describe(found),
    }


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
        f"grids (.label) and pictures (.png) in {cli.shown(folder)}"
        + (f"; {len(failed)} failed, listed in predictions.json" if failed else "")
    )


def describe(prediction: Prediction) -> list[dict[str, Any]]:
    """The objects of an image for ``predictions.json``; 3D boxes in metres."""
    columns = (prediction.classes, prediction.scores, prediction.boxes_xyxy, prediction.boxes3d)
    return [
        {
            "class": CLASS_NAMES[class_id],
            "score": round(float(score), 4),
            "box_xyxy": [round(float(value), 1) for value in box],
            "box3d_center": [round(float(value), 2) for value in box3d[:3]],
            "box3d_size": [round(float(value), 2) for value in box3d[3:]],
        }
        for class_id, score, box, box3d in zip(*columns, strict=True)
    ]


if __name__ == "__main__":
    main()
