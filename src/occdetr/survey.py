"""What synthetic streets are like, beside SemanticKITTI: ``python -m occdetr.survey``.

Makes worlds anew, so it needs no data set: class frequencies, occupied and valid share of the grid,
agreement of pictures and voxels, seconds a frame, and a sheet of frames to look at.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import cv2
import numpy as np
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.drawing.boxes import Image, class_legend
from occdetr.drawing.grids import render_grid
from occdetr.errors import InputError
from occdetr.files import write_image, write_json
from occdetr.streets.moment import Camera
from occdetr.streets.statistics import WorldSurvey, survey_world
from occdetr.streets.writer import GENERATOR_VERSION

#: Per cent of the labelled voxels of SemanticKITTI's training set, and shares of its grid.
PUBLISHED = {
    "car": 3.92, "bicycle": 0.03, "motorcycle": 0.03, "truck": 0.16, "other-vehicle": 0.20,
    "person": 0.07, "bicyclist": 0.07, "motorcyclist": 0.05, "road": 15.30, "parking": 1.12,
    "sidewalk": 11.13, "other-ground": 0.56, "building": 14.10, "fence": 3.90, "vegetation": 39.30,
    "trunk": 0.51, "terrain": 9.17, "pole": 0.29, "traffic-sign": 0.08,
}  # fmt: skip
PUBLISHED_OCCUPIED, PUBLISHED_VALID = 5.0, 72.0
SPLITS = ("train", "val")


@cli.entry_point("survey")
def main(config: DictConfig) -> None:
    """Leave ``survey.json`` and ``sheet.jpg`` in the run's folder, and print a table."""
    _check(config)
    shown = set(np.random.default_rng(config.seed).permutation(config.worlds)[: config.sheet])
    camera = Camera(tuple(config.image_size), config.horizontal_fov)
    surveys, rows = [], []
    for index, survey in enumerate(_survey_worlds(config, camera)):
        surveys.append(summarize(survey))
        if index in shown:
            rows.append(sheet_row(survey, camera, config.sheet_width))
    report = {
        "generator_version": GENERATOR_VERSION,
        "seed": config.seed,
        "split": config.split,
        "image_size": list(config.image_size),
        **total(surveys),
    }
    folder = cli.run_folder()
    write_json(folder / "survey.json", report)
    Console().print(_table(report))
    print(_sentences(report))
    if rows:
        write_image(folder / "sheet.jpg", make_sheet(rows))
    print(f"written: {cli.shown(folder)}")


def _check(config: DictConfig) -> None:
    for name, least in (("worlds", 1), ("seed", 0), ("workers", 0), ("sheet", 0)):
        if config[name] < least:
            raise InputError(f"{name}={config[name]}: give {least} or more")
    if config.split not in SPLITS:
        raise InputError(f"split={config.split}: choose one of {', '.join(SPLITS)}")
    if min(config.image_size) < 32:
        raise InputError(f"image_size={list(config.image_size)}: give 32 pixels or more")


def _survey_worlds(config: DictConfig, camera: Camera) -> Iterator[WorldSurvey]:
    """The surveys in the order of the worlds; the first one also compiles the ray tracer."""
    split = SPLITS.index(config.split)
    arguments = [(config.seed, split, index, camera) for index in range(config.worlds)]
    survey_world(*arguments[0])
    workers = min(config.workers or os.cpu_count() or 1, config.worlds)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker) as pool:
        surveys = pool.map(survey_world, *zip(*arguments, strict=True))
        yield from track(surveys, "surveying", total=len(arguments), transient=True)


def _start_worker() -> None:
    cv2.setNumThreads(1)  # one process a core
    survey_world(0, 0, 0, Camera((64, 212)))  # loads compiled code, which no frame should pay for


def summarize(survey: WorldSurvey) -> dict[str, Any]:
    """The numbers of one frame."""
    return {
        "counts": survey.counts,
        "occupied": survey.occupied,
        "valid": survey.valid,
        "agreement": vars(survey.agreement),
        "seconds": survey.seconds,
    }


def total(surveys: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over all frames; ``classes`` in per cent of all labelled voxels, seconds in medians."""
    counts = np.sum([survey["counts"] for survey in surveys], axis=0)[1:]
    seen = {
        name: sum(survey["agreement"][name] for survey in surveys)
        for name in surveys[0]["agreement"]
    }
    frames_with = np.sum([survey["counts"][1:] > 0 for survey in surveys], axis=0)
    seconds = [survey["seconds"] | {"frame": sum(survey["seconds"].values())} for survey in surveys]
    return {
        "worlds": len(surveys),
        "occupied": 100 * float(np.mean([survey["occupied"] for survey in surveys])),
        "valid": 100 * float(np.mean([survey["valid"] for survey in surveys])),
        "classes": {
            name: {
                "share": 100 * float(counts[i] / counts.sum()),
                "published": PUBLISHED[name],
                "frames": int(frames_with[i]),
            }
            for i, name in enumerate(CLASS_NAMES[1:])
        },
        "agreement": {
            "surfaces": 100 * seen["same"] / seen["pixels"],
            "labels": 100 * seen["known_same"] / seen["known"],
            "known": 100 * seen["known"] / seen["pixels"],
            "silhouettes": 100 * seen["silhouettes"] / (seen["silhouettes"] + seen["pixels"]),
        },
        "seconds": {part: float(np.median([s[part] for s in seconds])) for part in seconds[0]},
    }


def _table(report: dict[str, Any]) -> Table:
    table = Table(title=f"{report['worlds']} worlds: per cent of labelled voxels")
    table.add_column("class")
    for column in ("streets", "SemanticKITTI", "ratio", "frames with it"):
        table.add_column(column, justify="right")
    for name, row in report["classes"].items():
        ratio = row["share"] / row["published"]
        shares = f"{row['share']:.2f}", f"{row['published']:.2f}", f"{ratio:.2f}"
        table.add_row(name, *shares, f"{100 * row['frames'] / report['worlds']:.0f} %")
    table.add_section()
    for name, published in (("occupied", PUBLISHED_OCCUPIED), ("valid", PUBLISHED_VALID)):
        share = report[name]
        shown = f"{share:.2f}", f"{published:.2f}", f"{share / published:.2f}"
        table.add_row(f"{name}, of the grid", *shown, "")
    return table


def _sentences(report: dict[str, Any]) -> str:
    same, seconds = report["agreement"], report["seconds"]
    parts = ", ".join(f"{part} {value:.2f}" for part, value in seconds.items() if part != "frame")
    return (
        f"pixels nearer than 40 m that agree with the first voxel on their ray: "
        f"{same['surfaces']:.1f} % (all surfaces), {same['labels']:.1f} % (label files, where "
        f"known: {same['known']:.1f} %); silhouettes apart: {same['silhouettes']:.1f} %\n"
        f"seconds a frame on one core, median: {seconds['frame']:.2f} ({parts})"
    )


def sheet_row(survey: WorldSurvey, camera: Camera, width: int) -> Image:
    """Image, the labels as its camera sees them, and the labels from behind and above."""
    labels = survey.scan.labels
    wide = int(0.38 * width)
    height = round(wide * camera.image_size[0] / camera.image_size[1])
    picture = cv2.resize(survey.image, (wide, height), interpolation=cv2.INTER_AREA)
    calibration = camera.calibration
    scale = wide / camera.image_size[1], height / camera.image_size[0]
    projection = calibration.projection.copy()
    projection[0] *= scale[0]
    projection[1] *= scale[1]
    through = projection, calibration.lidar_to_camera
    seen = render_grid(labels, "camera", (height, wide), through)
    raised = render_grid(labels, "raised", (height, width - 2 * wide - 8))
    gap = np.full((height, 4, 3), 255, dtype=np.uint8)
    return np.hstack([picture, gap, seen, gap, raised])


def make_sheet(rows: list[Image]) -> Image:
    """The rows below each other, above the legend of classes."""
    gap = np.full((4, rows[0].shape[1], 3), 255, dtype=np.uint8)
    legend = class_legend(rows[0].shape[1])
    return np.vstack([part for row in rows for part in (row, gap)] + [legend])


if __name__ == "__main__":
    main()
