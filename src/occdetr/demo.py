"""The whole pipeline in one command: ``python -m occdetr.demo`` (or ``make demo``).

Synthetic streets, object labels and a short training in both stages. On held-out streets, what was
trained is evaluated beside the model that comes with the package, which was trained for longer, and
the position baseline. A prediction of the model that comes with the package is drawn.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from occdetr.api import Camera, load
from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.cli.folders import taken
from occdetr.cli.overrides import command_line, overrides_of, refuse_overrides
from occdetr.cli.subprocesses import run_entry_point
from occdetr.data.frames import Frame
from occdetr.data.semantickitti import read_labels
from occdetr.data.stopwatch import Stopwatch
from occdetr.drawing.panels import scene_panel
from occdetr.evaluation.position_baseline import score_baseline
from occdetr.files import write_image, write_json
from occdetr.training.checkpoint import restore_model

SCORES = ("mIoU", "IoU", "precision", "recall", "AP50", "mAP", "recall3d_25")
#: What is trained, and the data set of that experiment, whose labels are made first.
EXPERIMENT, DATA = "demo", "synthetic_demo"
#: What takes the time, in order.
PARTS = {
    "streets": "streets",
    "labels": "object labels",
    "pretrain": "pretraining",
    "full": "full training",
    "evaluate": "evaluation",
    "released": "evaluation of the released model",
    "exchanged": "the same with other images",
    "baseline": "position baseline",
    "picture": "picture of a prediction",
}
_STAGES = "the demo trains both stages, one from the other: leave it out"
_CLASSES = "the models of the table would find objects of different classes: leave it out"
#: What overrides of the trainings may not change (patterns), and what to do instead.
DECIDED = {
    "data": f"the demo has data={DATA} for all models: give its settings, as in data.num_train=240",
    "experiment": f"the demo trains experiment={EXPERIMENT}: give settings, as in epochs.full=3",
    **dict.fromkeys(("stage", "stage_name", "init_from", "resume"), _STAGES),
    **dict.fromkeys(("partition*", "*_classes", "*.classes", "model.detector"), _CLASSES),
    **dict.fromkeys(("outputs", "hydra", "hydra[./]*"), "give folder= beside overrides"),
}


@cli.entry_point("demo", takes_folder=False)
def main(config: DictConfig) -> None:
    """Write ``metrics.json`` and ``prediction.png`` into ``config.folder`` and print a table.

    A former demonstration there is replaced.
    """
    refuse_overrides(config.overrides, DECIDED)
    for stage in ("pretrain", "full"):  # a wrong setting is reported now, not after the streets
        cli.compose_checked("train", [f"stage={stage}", *training_overrides(config)])
    restore_model(config.released)
    with taken(Path(config.folder), "demo", "folder", again=True) as folder:
        demonstrate(config, folder)


def demonstrate(config: DictConfig, folder: Path) -> None:
    """The whole pipeline, in ``folder``."""
    watch = Stopwatch()
    checkpoint = prepare_and_train(config, folder, watch)
    given = data_overrides(config)
    metrics = evaluate(checkpoint, folder / "evaluate")
    watch.lap("evaluate")
    released = evaluate(config.released, folder / "released", *given)
    watch.lap("released")
    exchanged = evaluate(config.released, folder / "exchanged", *given, "exchange_images=true")
    watch.lap("exchanged")
    settings = cli.compose("train", ["stage=full", *training_overrides(config)])
    datamodule = cli.build(settings.data)
    held_out = datamodule.frames("val")
    baseline = score_baseline(datamodule.frames("train"), held_out)
    watch.lap("baseline")
    picture = draw_prediction(config.released, held_out[config.picture_frame % len(held_out)])
    write_image(folder / "prediction.png", picture)
    watch.lap("picture")
    seconds = {part: round(value, 1) for part, value in watch.seconds.items()}
    columns = {
        "released": released,
        "other images": exchanged,
        "trained here": metrics,
        "positions": baseline,
    }
    names = ("released", "released_exchanged", "trained", "baseline")
    scores = dict(zip(names, columns.values(), strict=True))
    write_json(folder / "metrics.json", scores | {"seconds": seconds})
    print_comparison(columns, f"{len(held_out)} held-out streets, in %")
    print(
        f"released: checkpoint={config.released}; other images: the same, with the images of other "
        "streets; positions: the most frequent class at each voxel"
    )
    total = sum(seconds.values())
    print_seconds(seconds)
    command = command_line("occdetr.predict", [f"checkpoint={config.released}"])
    print(
        f"done in {total / 60:.1f} min: {cli.shown(folder / 'prediction.png')}, "
        f"{cli.shown(folder / 'metrics.json')}; next: {command} "
        "images=<file|folder> calib=<calib.txt>"
    )


def data_overrides(config: DictConfig) -> list[str]:
    """Overrides that choose the data of the demonstration."""
    return [f"data={DATA}", *overrides_of("data", config.overrides)]


def training_overrides(config: DictConfig) -> list[str]:
    """Overrides of both training stages."""
    return [f"experiment={EXPERIMENT}", *config.overrides]


def prepare_and_train(config: DictConfig, folder: Path, watch: Stopwatch) -> Path:
    """Make the data and train both stages; returns the checkpoint."""
    run_entry_point("prepare", data_overrides(config), folder / "prepare")
    watch.lap("streets")
    labels = json.loads((folder / "prepare" / "prepare.json").read_text())["seconds"]
    watch.seconds |= {"streets": watch.seconds["streets"] - labels, "labels": labels}
    pretrain = ["stage=pretrain", *training_overrides(config)]
    run_entry_point("train", pretrain, folder / "pretrain")
    watch.lap("pretrain")
    init_from = f"init_from={folder / 'pretrain' / 'last.ckpt'}"
    full = ["stage=full", init_from, *training_overrides(config)]
    run_entry_point("train", full, folder / "full")
    watch.lap("full")
    return folder / "full" / "last.ckpt"


def evaluate(checkpoint: Path | str, folder: Path, *overrides: str) -> dict[str, Any]:
    """Run ``occdetr.evaluate`` on a checkpoint; returns its metrics."""
    run_entry_point("evaluate", [f"checkpoint={checkpoint}", *overrides], folder)
    return json.loads((folder / "metrics.json").read_text())


def draw_prediction(checkpoint: Path | str, frame: Frame) -> Any:
    """A held-out frame: its image with predicted boxes, the true and the predicted grid."""
    found = load(checkpoint, "cpu")(frame.image, Camera.from_kitti(frame.calibration))
    objects, title = (found.boxes, found.classes, found.scores), f"held-out street {frame.id}"
    return scene_panel(found.image, *objects, read_labels(frame), found.grid, title=title)


def print_comparison(columns: Mapping[str, Mapping[str, Any]], title: str) -> None:
    """Print the scores of each column side by side, then the IoU of the classes that occur."""
    table = Table(title=title)
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")
    for key in SCORES:
        cells = [
            f"{100 * scores[key]:.2f}" if key in scores else "-" for scores in columns.values()
        ]
        table.add_row(key, *cells)
    table.add_section()
    for name in CLASS_NAMES[1:]:
        ious = [scores["per_class"][name] for scores in columns.values()]
        if any(ious):
            table.add_row(name, *[f"{100 * iou:.2f}" for iou in ious])
    Console().print(table)


def print_seconds(seconds: Mapping[str, float]) -> None:
    """Print the time of each part of the demonstration."""
    table = Table(title="time by part")
    for heading in ("part", "seconds", "share"):
        table.add_column(heading, justify="left" if heading == "part" else "right")
    total = sum(seconds.values())
    for part, value in seconds.items():
        table.add_row(PARTS[part], f"{value:.1f}", f"{value / total:.0%}")
    Console().print(table)


if __name__ == "__main__":
    main()
