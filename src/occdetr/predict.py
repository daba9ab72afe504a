"""Images without labels -> grids and pictures.

``python -m occdetr.predict checkpoint=... images=<file|folder|glob> calib=<calib.txt>``
"""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.progress import track

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.data.dataset import PictureDataset, collate
from occdetr.data.images import read_picture
from occdetr.data.semantickitti import write_labels
from occdetr.drawing.panels import scene_panel
from occdetr.errors import InputError
from occdetr.files import read_image, write_image, write_json
from occdetr.models.inference import Prediction, predict
from occdetr.training.checkpoint import restore_model
from occdetr.training.device import choose_device
from occdetr.training.trainer import seed_everything

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")


@cli.entry_point("predict")
def main(config: DictConfig) -> None:
    """Leave a ``.label`` and a ``.png`` per image and ``predictions.json`` in the run's folder."""
    seed_everything(config.seed)
    checkpoint = cli.required(config, "checkpoint", "outputs/full/<run>/best.ckpt")
    images = find_images(cli.required(config, "images", "photos/"))
    calib = Path(cli.required(config, "calib", "sequences/08/calib.txt"))
    read_picture(images[0], calib)  # reports a wrong calib.txt before the network is built
    device = choose_device(config.device)
    model = restore_model(checkpoint, cli.plain(config.allow))[0].to(device)
    if config.score_threshold is not None:
        model.fusion.score_threshold = float(config.score_threshold)
    folder, found = cli.run_folder(), []
    pictures = PictureDataset(images, calib, model.image_size)
    for index, path in enumerate(track(images, description="predicting", transient=True)):
        image = read_image(path)
        batch = collate([pictures[index]]).to(device)
        (prediction,) = predict(model, batch, [image.shape[:2]])
        write_labels(folder / f"{path.stem}.label", prediction.grid)
        objects = (prediction.boxes_xyxy, prediction.classes, prediction.scores)
        panel = scene_panel(image, *objects, None, prediction.grid, title=path.name)
        write_image(folder / f"{path.stem}.png", panel)
        found.append(describe(path, prediction))
    summary = {"checkpoint": str(checkpoint), "calib": str(calib), "images": found}
    write_json(folder / "predictions.json", summary)
    count = sum(len(entry["objects"]) for entry in found)
    print(
        f"done: {len(found)} image{'' if len(found) == 1 else 's'}, {count} objects; "
        f"grids (.label) and pictures (.png) in {cli.shown(folder)}"
    )


def find_images(pattern: str) -> list[Path]:
    """The images that a file, a folder or a glob pattern means, sorted.

    Raises ``InputError`` if there are none, or two would have the same output name.
    """
    path = Path(pattern).expanduser()
    if path.is_dir():
        images = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES]
    elif path.is_file():
        images = [path]
    else:
        images = [Path(file) for file in glob.glob(str(path)) if Path(file).is_file()]
    if not images:
        raise InputError(
            f"images={pattern}: no image there: give a file, a folder with "
            f"{', '.join(SUFFIXES)} files, or a quoted pattern"
        )
    seen: dict[str, Path] = {}
    for image in sorted(images):
        if image.stem in seen:
            raise InputError(
                f"images={pattern}: {seen[image.stem]} and {image} have the same name: "
                "predict them one folder at a time"
            )
        seen[image.stem] = image
    return sorted(images)


def describe(path: Path, prediction: Prediction) -> dict[str, Any]:
    """The entry of an image in ``predictions.json``."""
    columns = (prediction.classes, prediction.scores, prediction.boxes_xyxy, prediction.boxes3d)
    objects = [
        {
            "class": CLASS_NAMES[class_id],
            "score": round(float(score), 4),
            "box_xyxy": [round(float(value), 1) for value in box],
            "box3d_center": [round(float(value), 2) for value in box3d[:3]],
            "box3d_size": [round(float(value), 2) for value in box3d[3:]],
        }
        for class_id, score, box, box3d in zip(*columns, strict=True)
    ]
    files = {"label": f"{path.stem}.label", "picture": f"{path.stem}.png"}
    return {"image": str(path), **files, "objects": objects}


if __name__ == "__main__":
    main()
