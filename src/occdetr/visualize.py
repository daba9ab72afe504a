"""Images of the object labels, as in the paper's Fig. 5.

``python -m occdetr.visualize labels data=... data.root=... frames=00/000000,04/000005``
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.progress import track

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.data.frames import LABELLED_SPLITS, Frame, choose_frames
from occdetr.data.images import load_picture
from occdetr.data.objects import SceneObjects
from occdetr.data.semantickitti import read_labels
from occdetr.drawing.boxes import Image
from occdetr.drawing.panels import label_panel
from occdetr.errors import InputError
from occdetr.files import image_size_of, write_image, write_json


def main() -> None:
    """Write a ``.png`` per frame and ``labels.json`` to the run's folder."""
    sys.argv[1:] = complete_overrides(sys.argv[1:])
    draw_labels()


def complete_overrides(words: list[str]) -> list[str]:
    """The command line as Hydra takes it: ``labels`` becomes ``what=labels``, and a list of frames
    is quoted, so that its commas do not mean a sweep, unless there is ``-m``."""
    if words and re.fullmatch(r"[a-z]+", words[0]):
        words = [f"what={words[0]}", *words[1:]]
    if {"-m", "--multirun"} & set(words):
        return words
    return [re.sub(r"^frames=([\w/, ]+)$", r"frames='\1'", word) for word in words]


@cli.entry_point("visualize")
def draw_labels(config: DictConfig) -> None:
    """Draw the chosen frames, and describe their objects."""
    _check(config)
    datamodule = cli.build(config.data)
    datamodule.prepare_data()
    where = f"split={config.split} of {datamodule.root}"
    frames = choose_frames(datamodule.frames(config.split), cli.plain(config.frames), where)
    print(datamodule.summary(config.split), flush=True)
    folder, found = cli.run_folder(), []
    for frame in track(frames, description="drawing", transient=True):
        objects = datamodule.labels.load_or_build(frame)
        picture = f"{frame.id.replace('/', '_')}.png"
        panel = draw_frame(
            frame, objects, datamodule.labels.settings.classes, config.width, config.photograph
        )
        write_image(folder / picture, panel)
        found.append({"frame": frame.id, "picture": picture, "objects": describe(objects)})
    summary = {"root": str(datamodule.root), "split": config.split, "frames": found}
    write_json(folder / "labels.json", summary)
    count = sum(len(entry["objects"]) for entry in found)
    print(
        f"done: {len(found)} frame{'' if len(found) == 1 else 's'}, {count} objects; "
        f"pictures (.png) and labels.json in {cli.shown(folder)}"
    )


def _check(config: DictConfig) -> None:
    if config.what != "labels":
        raise InputError(f"what={config.what}: no such pictures: use labels")
    if config.split not in LABELLED_SPLITS:
        raise InputError(f"split={config.split}: labels exist for train and val")


def draw_frame(
    frame: Frame,
    objects: SceneObjects,
    object_classes: Sequence[int],
    width: int,
    photograph: bool = True,
) -> Image:
    """The label panel of a frame, ``width`` pixels wide, with or without its photograph."""
    height, full_width = image_size_of(frame.image)
    size = (round(height * width / full_width), width)
    image, camera = load_picture(frame.image, frame.calibration, size)
    return label_panel(
        image if photograph else None,
        camera,
        read_labels(frame),
        objects,
        object_classes,
        title=f"{frame.id}: {len(objects)} objects",
    )


def describe(objects: SceneObjects) -> list[dict[str, Any]]:
    """The objects of a frame for ``labels.json``; 3D boxes in metres, grid frame."""
    voxels = np.bincount(objects.voxel_object, minlength=len(objects))
    return [
        {
            "number": number + 1,
            "class": CLASS_NAMES[objects.classes[number]],
            "visible_fraction": round(float(objects.visible_fraction[number]), 3),
            "voxels": int(voxels[number]),
            "box_cxcywh": [round(float(value), 4) for value in objects.boxes_cxcywh[number]],
            "box3d_center": [round(float(value), 2) for value in objects.boxes3d_grid[number, :3]],
            "box3d_size": [round(float(value), 2) for value in objects.boxes3d_grid[number, 3:]],
        }
        for number in range(len(objects))
    ]


if __name__ == "__main__":
    main()
