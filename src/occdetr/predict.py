"""Images without labels -> grids and pictures.

``python -m occdetr.predict checkpoint=... images=<file|folder|glob> calib=<calib.txt>``
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.progress import track

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.data.dataset import collate, make_item
from occdetr.data.find_images import find_images, output_names
from occdetr.data.images import read_picture, resize_picture
from occdetr.data.semantickitti import write_labels
from occdetr.drawing.panels import scene_panel
from occdetr.errors import InputError
from occdetr.files import count_pictures, write_image, write_json
from occdetr.geometry.kitti import read_calibration
from occdetr.models.inference import Prediction, predict
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.checkpoint import UNTRAINED_GRIDS, restore_model
from occdetr.training.device import choose_device
from occdetr.training.trainer import seed_everything

#: Exit code if some images could not be predicted.
SOME_FAILED = 3


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
    if trained.stage == "pretrain":
        print(f"note: {checkpoint}: {UNTRAINED_GRIDS}", flush=True)
    if config.score_threshold is not None:
        model.fusion.score_threshold = float(config.score_threshold)
    if skipped:
        print(f"note: images={wanted}: {skipped}", flush=True)
    found, failed = [], []
    jobs = list(zip(images, names, strict=True))
    for path, name in track(jobs, description="predicting", transient=True):
        try:
            found.append(predict_picture(model, path, calib, folder / name))
        except InputError as error:
            line = " ".join(str(error).splitlines())
            print(f"error: {line}", file=sys.stderr, flush=True)
            failed.append({"image": str(path), "error": line})
    if not found:
        raise InputError(f"images={wanted}: none of {len(failed)} images could be predicted")
    summary = {
        "checkpoint": str(checkpoint),
        "calib": str(calib),
        "images": found,
        "failed": failed,
    }
    write_json(folder / "predictions.json", summary)
    print(summarize(found, failed, folder))
    if failed:
        sys.exit(SOME_FAILED)


def predict_picture(model: OccupancyDETR, path: Path, calib: Path, output: Path) -> dict[str, Any]:
    """Predict an image, write the grid and the picture to ``output`` with their suffixes; returns
    its entry in ``predictions.json``. Raises ``InputError`` if the image cannot be used."""
    image, camera = read_picture(path, calib)
    if (number := count_pictures(path)) > 1:
        warnings.warn(f"{path}: has {number} pictures, only the first is used", stacklevel=2)
    item = make_item(*resize_picture(image, camera, model.image_size), 0, path.stem)
    batch = collate([item]).to(next(model.parameters()).device)
    (prediction,) = predict(model, batch, [(image.shape[0], image.shape[1])])
    files = {kind: output.with_name(f"{output.name}.{kind}") for kind in ("label", "png")}
    objects = (prediction.boxes_xyxy, prediction.classes, prediction.scores)
    panel = scene_panel(image, *objects, None, prediction.grid, title=f"{output.name}{path.suffix}")
    write_labels(files["label"], prediction.grid)
    write_image(files["png"], panel)
    return {
        "image": str(path),
        "label": files["label"].name,
        "picture": files["png"].name,
        "objects": describe(prediction),
    }


def summarize(found: Sequence[dict[str, Any]], failed: Sequence[Any], folder: Path) -> str:
    """What was done, in one line."""
    count = sum(len(entry["objects"]) for entry in found)
    of = f" of {len(found) + len(failed)}" if failed else ""
    return (
        f"done: {len(found)}{of} image{'' if len(found) == 1 and not failed else 's'}, "
        f"{count} objects; grids (.label) and pictures (.png) in {cli.shown(folder)}"
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
