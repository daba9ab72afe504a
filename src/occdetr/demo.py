"""The whole road in one command: ``python -m occdetr.demo`` (or ``make demo``).

Synthetic streets -> object labels -> both training stages -> evaluation on held-out streets,
beside the baseline that knows only positions -> a picture.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.cli.subprocesses import run_entry
from occdetr.data.dataset import PictureDataset, collate
from occdetr.data.frames import Frame
from occdetr.data.semantickitti import read_labels
from occdetr.drawing.grids import scene_panel
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.position_baseline import PositionBaseline
from occdetr.files import read_image, write_image, write_json
from occdetr.models.inference import predict
from occdetr.training.checkpoint import restore_model

FIGURES = ("mIoU", "IoU", "precision", "recall", "AP50", "mAP", "recall3d_25")


@cli.entry_point("demo")
def main(config: DictConfig) -> None:
    """Leave ``metrics.json`` and ``prediction.png`` in ``config.folder``, and print a table."""
    folder, experiment = Path(config.folder), f"experiment={config.experiment}"
    seconds: dict[str, float] = {}

    def run(entry: str, overrides: list[str], name: str = "") -> None:
        name = name or entry
        seconds[name] = run_entry(entry, overrides, folder / name).seconds

    shared = [experiment, *config.overrides]
    of_data = [text for text in config.overrides if text.startswith("data.")]
    run("prepare", [experiment, *of_data])
    run("train", ["stage=pretrain", *shared], "pretrain")
    start = f"init_from={folder / 'pretrain' / 'last.ckpt'}"
    run("train", ["stage=full", start, *shared], "full")
    checkpoint = folder / "full" / "last.ckpt"
    measured = f"checkpoint={checkpoint}"
    run("evaluate", [measured])
    metrics = json.loads((folder / "evaluate" / "metrics.json").read_text())
    exchanged = [measured, "exchange_images=true"]
    run("evaluate", exchanged, "evaluate_exchanged")
    blind = json.loads((folder / "evaluate_exchanged" / "metrics.json").read_text())
    settings = cli.compose("train", ["stage=full", *shared])
    data = cli.build(settings.data)
    held_out = data.frames("val")
    baseline = score_baseline(data.frames("train"), held_out)
    metrics |= {"exchanged": blind, "baseline": baseline, "seconds": seconds}
    picture = show_prediction(checkpoint, held_out[config.picture_frame % len(held_out)])
    write_image(folder / "prediction.png", picture)
    write_json(folder / "metrics.json", metrics)
    print_comparison(metrics, blind, baseline, f"{len(held_out)} held-out streets")
    total = sum(seconds.values())
    print(
        f"done in {total / 60:.1f} min: {cli.shown(folder / 'prediction.png')}, "
        f"{cli.shown(folder / 'metrics.json')}; next: python -m occdetr.predict "
        f"checkpoint={cli.shown(checkpoint)} images=<file|folder> calib=<calib.txt>"
    )


def score_baseline(train: list[Frame], held_out: list[Frame]) -> dict[str, Any]:
    """The figures of predicting, everywhere, the class most frequent there in ``train``."""
    baseline, metric = PositionBaseline(), SemanticSceneCompletion()
    for frame in track(train, description="position baseline", transient=True):
        baseline.update(read_labels(frame))
    prediction = torch.from_numpy(baseline.predict())[None]
    for frame in held_out:
        metric.update(prediction, torch.from_numpy(read_labels(frame))[None])
    return metric.compute()


def show_prediction(checkpoint: Path, frame: Frame) -> Any:
    """A held-out street: the picture with its boxes, ground truth and prediction."""
    model, _ = restore_model(checkpoint)
    image = read_image(frame.image)
    item = PictureDataset([frame.image], frame.calibration, model.image_size)[0]
    (found,) = predict(model, collate([item]), [image.shape[:2]])
    objects, title = (found.boxes_xyxy, found.classes, found.scores), f"held-out street {frame.id}"
    return scene_panel(image, *objects, read_labels(frame), found.grid, title=title)


def print_comparison(
    metrics: dict[str, Any], blind: dict[str, Any], baseline: dict[str, Any], title: str
) -> None:
    """The model beside itself with other frames' pictures and beside the baseline: all figures,
    then the classes that occur."""
    table = Table(title=f"{title}, in %")
    table.add_column("")
    table.add_column("OccupancyDETR", justify="right")
    table.add_column("with other frames' pictures", justify="right")
    table.add_column("position baseline", justify="right")
    for name in FIGURES:
        other = f"{100 * baseline[name]:.2f}" if name in baseline else "-"
        table.add_row(name, f"{100 * metrics[name]:.2f}", f"{100 * blind[name]:.2f}", other)
    table.add_section()
    for name in CLASS_NAMES[1:]:
        columns = [figures["per_class"][name] for figures in (metrics, blind, baseline)]
        if any(columns):
            table.add_row(name, *[f"{100 * figure:.2f}" for figure in columns])
    Console().print(table)


if __name__ == "__main__":
    main()
