"""Images without labels -> grids and pictures.

``python -m occdetr.predict checkpoint=tiny images=<file|folder|glob|video> calib=<file>``, or
``camera.fov=90 camera.height=1.6`` in place of ``calib``.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import track

from occdetr.api import Camera, load
from occdetr.api.files import SUFFIXES
from occdetr.api.lens_files import is_lens_file
from occdetr.api.stream import Job, Outputs, predict_all, video_jobs
from occdetr.api.video import Image, Video, VideoFile, is_video
from occdetr.api.viewer import Recording
from occdetr.api.views import make_views
from occdetr.cli import entry as cli
from occdetr.cli.sigterm import sigterm_interrupts
from occdetr.cli.submission import submit
from occdetr.data.find_images import find_images, output_names
from occdetr.errors import InputError
from occdetr.files import print_error, read_image, write_json
from occdetr.training.checkpoint import UNTRAINED_GRIDS
from occdetr.training.trainer import seed_everything

#: What ``predictions.json`` holds of an image.
Entry = dict[str, Any]
#: Exit code if some images could not be predicted.
SOME_FAILED = 3
#: (height, width) of the views of a check: of any network, but small.
ANY_SIZE = (128, 416)
#: Frames a second of a video of images: those of KITTI.
IMAGE_RATE = 10.0


@cli.entry_point("predict")
def main(config: DictConfig) -> None:
    """Leave the ``files`` of each image and ``predictions.json`` in the run's folder.

    Images that cannot be read are reported and left out, as is the rest of a video that ends early;
    the exit code is then ``SOME_FAILED``, or 2 if none was predicted. Ctrl-C and SIGTERM end it
    with what there is by then.
    """
    seed_everything(config.seed)
    checkpoint = cli.required(config, "checkpoint", "tiny")
    if config.submission is not None:
        submit(config)
        return
    refuse_settings_of_submissions()
    wanted, folder = str(cli.required(config, "images", "photos/")), cli.run_folder()
    camera = read_camera(config)
    images = find_video(config, wanted, camera) or find_pictures(config, wanted, folder, camera)
    kinds = kinds_of(config, isinstance(images, Video))
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
    if isinstance(images, Video):
        (name,) = output_names([images.path], folder)
        jobs, total = video_jobs(images, folder / name), images.count or None
    else:
        jobs, total = images, len(images)
    began = time.perf_counter()
    with sigterm_interrupts(), ExitStack() as files:
        outputs = open_outputs(config, images, kinds, files)
        results = predict_all(model, jobs, camera, outputs)
        found, failed, interrupted = collect(track(results, "predicting", total, transient=True))
        if isinstance(images, Video) and images.problem:
            failed.append({"image": str(images.path), "error": images.problem})
        if not found:
            raise InputError(f"images={wanted}: none of {len(failed)} images could be predicted")
    seconds = time.perf_counter() - began
    summary = {
        "checkpoint": str(checkpoint),
        "calib": None if config.calib is None else str(config.calib),
        "camera": cli.plain(config.camera),
        "images": found,
        "failed": failed,
        "interrupted": interrupted,
    }
    write_json(folder / "predictions.json", summary)
    together = [each.file for each in (outputs.video, outputs.recording) if each is not None]
    print(summarize(found, failed, seconds, folder, [*map(cli.shown, together)], bool(kinds)))
    if interrupted:
        raise KeyboardInterrupt
    if failed:
        sys.exit(SOME_FAILED)


def refuse_settings_of_submissions() -> None:
    """Raises ``InputError`` for a setting that has no effect on images."""
    for text in HydraConfig.get().overrides.task:
        if re.match(r"[+~]*(data|trainer|batch_size|description)\b", text):
            raise InputError(f"{text}: only for a submission: leave it out, or give submission=...")


def collect(results: Iterable[Entry]) -> tuple[list[Entry], list[Entry], bool]:
    """The entries of the images that were predicted, those of the others, and whether Ctrl-C or
    SIGTERM came between. Raises it again if nothing was predicted by then."""
    found, failed = list[Entry](), list[Entry]()
    try:
        for entry in results:
            if "error" in entry:
                print_error(entry["error"])
            (failed if "error" in entry else found).append(entry)
    except KeyboardInterrupt:
        if not found:
            raise
        return found, failed, True
    return found, failed, False


def find_video(config: DictConfig, wanted: str, camera: Camera) -> Video | None:
    """The video that ``images`` names, if it does. Raises ``InputError`` if it cannot be used."""
    file = Path(wanted).expanduser()
    if not (is_video(file) and file.is_file()):
        if config.frame_step != 1:
            raise InputError(f"frame_step={config.frame_step}: only for a video: leave it out")
        return None
    video = Video(file, config.frame_step)
    check_view(next(iter(video))[1], camera, file)
    return video


def find_pictures(config: DictConfig, wanted: str, folder: Path, camera: Camera) -> Sequence[Job]:
    """The image files that ``images`` means.

    Raises ``InputError`` if there is none, or if the only one is broken or does not fit the camera.
    """
    if config.fps is not None and config.video is None:
        raise InputError(f"fps={config.fps}: only for a video: give video=out.mp4, or leave it out")
    images, skipped = find_images(wanted)
    names = output_names(images, folder)
    if len(images) == 1:  # before the network is built
        check_view(read_image(images[0]), camera, images[0])
    if skipped:
        print(f"note: images={wanted}: {skipped}", flush=True)
    return [Job(path, folder / name) for path, name in zip(images, names, strict=True)]


def kinds_of(config: DictConfig, of_video: bool) -> list[str]:
    """The kinds of files that are written for each image. Raises ``InputError`` for others."""
    if config.files is None:
        return [] if of_video else ["label", "png"]
    if unknown := sorted(set(config.files) - {suffix[1:] for suffix in SUFFIXES}):
        known = ", ".join(suffix[1:] for suffix in SUFFIXES)
        raise InputError(f"files: {unknown[0]} is not known: choose of {known}")
    return list(config.files)


def open_outputs(
    config: DictConfig, images: Video | Sequence[Job], kinds: list[str], files: ExitStack
) -> Outputs:
    """What is written, opened in ``files``.

    Raises ``InputError`` for a viewer or a video that cannot be written.
    """
    if config.viewer not in (None, "rerun"):
        raise InputError(f"viewer={config.viewer}: is not known: use rerun or null")
    recording = video = None
    if config.viewer:
        recording = files.enter_context(Recording(cli.run_folder() / "predictions.rrd"))
    if config.video is not None or isinstance(images, Video):
        file = Path(str(config.video)).expanduser() if config.video else None
        if file is not None and file.exists():
            raise InputError(f"video={file}: exists: remove it, or give another name")
        rate = images.rate / images.step if isinstance(images, Video) else IMAGE_RATE
        video = VideoFile(file or cli.run_folder() / "predictions.mp4", config.fps or rate)
        files.enter_context(video)
    return Outputs(kinds, recording, video)


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


def check_view(image: Image, camera: Camera, file: Path) -> None:
    """Raises ``InputError`` if an image does not fit the camera."""
    try:
        make_views(image, camera, ANY_SIZE)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def summarize(
    found: Sequence[dict[str, Any]],
    failed: Sequence[Any],
    seconds: float,
    folder: Path,
    together: Sequence[str],
    of_each: bool,
) -> str:
    """What was done, in one line; ``seconds`` and the files ``together`` are of all images.

    ``of_each``: whether ``folder`` also has files of each image.
    """
    count = sum(len(entry["objects"]) for entry in found)
    of = f" of {len(found) + len(failed)}" if failed else ""
    images = f"{len(found)}{of} image{'' if len(found) == 1 and not failed else 's'}"
    return (
        f"done: {images}, {count} objects, {len(found) / seconds:.2f} frames/s; "
        + "".join(f"{file}; " for file in together)
        + f"{'their files and ' if of_each else ''}predictions.json in {cli.shown(folder)}"
        + (f"; {len(failed)} failed, listed in predictions.json" if failed else "")
    )


if __name__ == "__main__":
    main()
