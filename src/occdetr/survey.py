"""Statistics of synthetic streets compared with SemanticKITTI: ``python -m occdetr.survey``.

Worlds are generated again, so no data set is needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from occdetr.cli import entry as cli
from occdetr.data.frames import LABELLED_SPLITS
from occdetr.data.processes import available_cores
from occdetr.drawing.panels import contact_sheet, sheet_row
from occdetr.errors import InputError
from occdetr.files import write_image, write_json
from occdetr.geometry.kitti import kitti_camera
from occdetr.streets.statistics import (
    PUBLISHED_OCCUPIED,
    PUBLISHED_VALID,
    frame_numbers,
    summarize_surveys,
    survey_worlds,
)
from occdetr.streets.writer import GENERATOR_VERSION


@cli.entry_point("survey")
def main(config: DictConfig) -> None:
    """Write ``survey.json`` and ``sheet.jpg`` to the run's folder, and print a table."""
    _check(config)
    shown = set(np.random.default_rng(config.seed).permutation(config.worlds)[: config.sheet])
    camera = kitti_camera(tuple(config.image_size), config.horizontal_fov)
    split, workers = LABELLED_SPLITS.index(config.split), config.workers or available_cores()
    surveys = survey_worlds(config.seed, split, config.worlds, camera, workers)
    frames, rows = [], []
    for index, survey in enumerate(
        track(surveys, "surveying", total=config.worlds, transient=True)
    ):
        frames.append(frame_numbers(survey))
        if index in shown:
            rows.append(sheet_row(survey.image, camera, survey.scan.labels, config.sheet_width))
    report = {
        "generator_version": GENERATOR_VERSION,
        "seed": config.seed,
        "split": config.split,
        "image_size": list(config.image_size),
        **summarize_surveys(frames),
    }
    folder = cli.run_folder()
    write_json(folder / "survey.json", report)
    Console().print(_table(report))
    print(_sentences(report))
    if rows:
        write_image(folder / "sheet.jpg", contact_sheet(rows))
    print(f"written: {cli.shown(folder)}")


def _check(config: DictConfig) -> None:
    for name, least in (("worlds", 1), ("seed", 0), ("workers", 0), ("sheet", 0)):
        if config[name] < least:
            raise InputError(f"{name}={config[name]}: give {least} or more")
    if config.split not in LABELLED_SPLITS:
        raise InputError(f"split={config.split}: choose one of {', '.join(LABELLED_SPLITS)}")
    if min(config.image_size) < 32:
        raise InputError(f"image_size={list(config.image_size)}: give 32 pixels or more")


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
        f"pixels nearer than 40 m with the class of the first voxel on their ray: "
        f"{same['surfaces']:.1f} % (all surfaces), {same['labels']:.1f} % (label files, where "
        f"known: {same['known']:.1f} %); not counted, near silhouettes: "
        f"{same['silhouettes']:.1f} %\n"
        f"seconds per frame on one core, median: {seconds['frame']:.2f} ({parts})"
    )


if __name__ == "__main__":
    main()
