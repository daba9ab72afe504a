"""Score predictions of any method: ``python -m occdetr.score predictions=... data.root=...``.

The figures are those of ``occdetr.evaluate``, and RayIoU.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich.progress import track

from occdetr.classes import IGNORE
from occdetr.cli import entry as cli
from occdetr.cli.report import print_completion, print_rays, write_confusion
from occdetr.data.ahead import map_ahead
from occdetr.data.frames import LABELLED_SPLITS, Frame
from occdetr.data.processes import available_cores
from occdetr.data.semantickitti import read_labels, read_raw_labels, remap_labels
from occdetr.errors import InputError
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.ray_iou import RayIoU
from occdetr.files import write_json


@cli.entry_point("score")
def main(config: DictConfig) -> float:
    """Print tables and write ``metrics.json`` and the confusion matrix; returns the mIoU."""
    folder = Path(str(cli.required(config, "predictions", "outputs/evaluate/<run>/predictions")))
    if config.split not in LABELLED_SPLITS:
        raise InputError(f"split={config.split}: has no labels here: use {LABELLED_SPLITS}")
    datamodule = cli.build(config.data)
    datamodule.prepare_data()
    frames = datamodule.frames(config.split)
    files = prediction_files(folder.expanduser(), frames)
    print(f"{folder} on {datamodule.summary(config.split)}", flush=True)
    completion, rays = SemanticSceneCompletion(), RayIoU()
    workers = int(config.workers) or available_cores()
    pairs = map_ahead(read_pair, zip(files, frames, strict=True), threads=workers)
    for found, truth in track(pairs, total=len(files), description="frames", transient=True):
        grids = torch.from_numpy(found)[None], torch.from_numpy(truth)[None]
        completion.update(*grids)
        rays.update(*grids)
    scores, by_rays = completion.compute(), rays.compute()
    confusion = np.array(scores.pop("confusion"))
    run = cli.run_folder()
    measured = {"predictions": str(folder), "split": config.split}
    write_json(run / "metrics.json", {**scores, "rays": by_rays, **measured})
    write_confusion(run, confusion.sum(axis=0))
    print_completion({**scores, **measured}, confusion)
    print_rays(by_rays)
    paths = ", ".join(cli.shown(run / name) for name in ("metrics.json", "confusion.png"))
    print(f"done: {len(files)} frames, {paths}")
    return scores["mIoU"]


def prediction_files(folder: Path, frames: Sequence[Frame]) -> list[Path]:
    """The prediction of each frame. Raises ``InputError`` if one is missing."""
    files = [
        folder / "sequences" / frame.sequence / "predictions" / f"{frame.name}.label"
        for frame in frames
    ]
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise InputError(
            f"{missing[0]}: file is missing, as {len(missing)} of {len(files)} predictions: give "
            "the folder that has the folder sequences, or other data.val_sequences or data.stride"
        )
    return files


def read_pair(
    pair: tuple[Path, Frame],
) -> tuple[UInt8[NDArray, "x y z"], UInt8[NDArray, "x y z"]]:
    """The predicted and the true classes of a frame.

    As in SemanticKITTI's evaluator, predicted ids that ``learning_map`` maps to 0 are empty.
    """
    file, frame = pair
    found = remap_labels(read_raw_labels(file), source=file)
    return np.where(found == IGNORE, 0, found).astype(np.uint8), read_labels(frame)


if __name__ == "__main__":
    main()
