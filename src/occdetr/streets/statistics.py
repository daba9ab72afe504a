"""Statistics of synthetic streets: class frequencies, agreement of images and voxels, time."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from occdetr.classes import CLASS_NAMES, NUM_CLASSES
from occdetr.data.parallel import in_processes
from occdetr.data.stopwatch import Stopwatch
from occdetr.geometry.camera import Camera
from occdetr.geometry.kitti import kitti_camera
from occdetr.streets.agreement import Agreement, compare_pixels
from occdetr.streets.scan import Scan
from occdetr.streets.world import World

#: Per cent of the labelled voxels of SemanticKITTI's training set, and of its grid.
PUBLISHED = {
    "car": 3.92, "bicycle": 0.03, "motorcycle": 0.03, "truck": 0.16, "other-vehicle": 0.20,
    "person": 0.07, "bicyclist": 0.07, "motorcyclist": 0.05, "road": 15.30, "parking": 1.12,
    "sidewalk": 11.13, "other-ground": 0.56, "building": 14.10, "fence": 3.90, "vegetation": 39.30,
    "trunk": 0.51, "terrain": 9.17, "pole": 0.29, "traffic-sign": 0.08,
}  # fmt: skip
PUBLISHED_OCCUPIED, PUBLISHED_VALID = 5.0, 72.0


@dataclass(frozen=True)
class WorldSurvey:
    """The first frame of a world: its voxels by class, shares (0-1) of the grid that are occupied
    and valid, and the seconds of each step."""

    counts: Int[np.ndarray, " class"]
    occupied: float
    valid: float
    agreement: Agreement
    seconds: dict[str, float]
    image: UInt8[np.ndarray, "height width 3"] = field(repr=False)
    scan: Scan = field(repr=False)


def survey_world(seed: int, split: int, index: int, camera: Camera) -> WorldSurvey:
    """Generate the first frame of a world and measure it; the steps are ``world``, ``picture``,
    ``voxels`` and ``sweeps``."""
    watch = Stopwatch()
    snapshot = World(seed, split, index).snapshot()
    watch.lap("world")
    view = snapshot.view(camera)
    image = snapshot.picture(view)
    watch.lap("picture")
    voxels = snapshot.voxels()
    watch.lap("voxels")
    scan = snapshot.sweep(voxels)
    watch.lap("sweeps")
    return WorldSurvey(
        counts=np.bincount(scan.labels.ravel(), minlength=NUM_CLASSES),
        occupied=float((scan.labels > 0).mean()),
        valid=float((~scan.invalid).mean()),
        agreement=compare_pixels(snapshot, view, camera, voxels.classes, scan),
        seconds=watch.seconds,
        image=image,
        scan=scan,
    )


def survey_worlds(
    seed: int, split: int, worlds: int, camera: Camera, workers: int
) -> Iterator[WorldSurvey]:
    """Survey the first worlds of a split (0 train, 1 val) in parallel processes, in order."""
    survey_world(seed, split, 0, camera)  # compiles into numba's cache, which all processes read
    survey = functools.partial(survey_world, seed, split, camera=camera)
    yield from in_processes(survey, range(worlds), min(workers, worlds), _start_worker)


def _start_worker() -> None:
    cv2.setNumThreads(1)  # one process for each core
    survey_world(0, 0, 0, kitti_camera((64, 212)))  # loads compiled code outside the measured time


def frame_numbers(survey: WorldSurvey) -> dict[str, Any]:
    """The numbers of one frame, without its image and voxels."""
    return {
        "counts": survey.counts,
        "occupied": survey.occupied,
        "valid": survey.valid,
        "agreement": vars(survey.agreement),
        "seconds": survey.seconds,
    }


def summarize_surveys(surveys: list[dict[str, Any]]) -> dict[str, Any]:
    """Statistics over all frames in per cent.

    ``classes`` has shares of all labelled voxels, ``occupied`` and ``valid`` are shares of the
    grid, ``agreement`` is explained at ``Agreement``, ``seconds`` are medians.
    """
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
