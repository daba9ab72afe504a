"""Pictures of the object labels, as the paper's Fig. 5 shows them.

``python -m occdetr.visualize labels data=... data.root=... frames=00/000000,04/000005``
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig
from rich.progress import track

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.data.cache import image_size_of, load_or_build
from occdetr.data.dataset import load_picture
from occdetr.data.frames import Frame
from occdetr.data.objects import SceneObjects
from occdetr.data.semantickitti import read_labels
from occdetr.drawing.boxes import (
    BACKGROUND,
    MARGIN,
    Image,
    color_legend,
    draw_boxes3d,
    draw_named_boxes,
    with_title,
)
from occdetr.drawing.grids import (
    UNCLAIMED,
    bird_camera,
    object_colors,
    paint_objects,
    raised_camera,
    render_grid,
    render_with_depth,
)
from occdetr.drawing.wireframe import Camera
from occdetr.errors import InputError
from occdetr.files import write_image, write_json
from occdetr.geometry.camera import denormalize_pixels


def main() -> None:
    """Leave a ``.png`` per frame and ``labels.json`` in the run's folder."""
    sys.argv[1:] = spelt_out(sys.argv[1:])
    draw_labels()


def spelt_out(words: list[str]) -> list[str]:
    """A command line as Hydra takes it: ``labels`` is ``what=labels``, and commas between frames
    belong to one value, unless a sweep (``-m``) is asked for."""
    if words and re.fullmatch(r"[a-z]+", words[0]):
        words = [f"what={words[0]}", *words[1:]]
    if {"-m", "--multirun"} & set(words):
        return words
    return [re.sub(r"^frames=([\w/, ]+)$", r"frames='\1'", word) for word in words]


@cli.entry_point("visualize")
def draw_labels(config: DictConfig) -> None:
    """Draw the frames that are asked for, and describe their objects."""
    _check(config)
    datamodule = cli.build(config.data)
    datamodule.prepare_data()
    where = f"split={config.split} of {datamodule.root}"
    frames = choose_frames(datamodule.frames(config.split), cli.plain(config.frames), where)
    print(datamodule.summary(config.split), flush=True)
    settings = datamodule.object_settings
    folder, found = cli.run_folder(), []
    for frame in track(frames, description="drawing", transient=True):
        objects = load_or_build(frame, settings, datamodule.cache_dir)
        picture = f"{frame.id.replace('/', '_')}.png"
        panel = label_panel(frame, objects, settings.classes, config.width, config.photograph)
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
    if config.split not in ("train", "val"):
        raise InputError(f"split={config.split}: labels exist for train and val")
    if not isinstance(config.width, int) or config.width < 320:
        raise InputError(f"width={config.width}: give 320 pixels or more")


def choose_frames(frames: Sequence[Frame], wanted: Any, where: str) -> list[Frame]:
    """``all``, the first so many (a number), or those named in ``NN/NNNNNN,NN/NNNNNN``.

    ``where`` is what an error calls the place of ``frames``. Raises ``InputError``, saying which
    frames there are, if one does not exist or none is named.
    """
    text = ",".join(map(str, wanted)) if isinstance(wanted, list) else str(wanted).strip()
    if text == "all":
        return list(frames)
    if text.isdecimal() and int(text) > 0:
        return list(frames[: int(text)])
    by_id = {frame.id: frame for frame in frames}
    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if name not in by_id:
            raise InputError(
                f"frames={name}: no such frame in {where}: "
                f"use all, a number, or names of {_listed(frames)}"
            )
    return [by_id[name] for name in names]


def _listed(frames: Sequence[Frame]) -> str:
    """Each sequence's first and last frame: ``00/000000 to 000005 (2), ...``."""
    names: dict[str, list[str]] = {}
    for frame in frames:
        names.setdefault(frame.sequence, []).append(frame.name)
    return ", ".join(
        f"{sequence}/{found[0]} to {found[-1]} ({len(found)})" for sequence, found in names.items()
    )


def label_panel(
    frame: Frame,
    objects: SceneObjects,
    object_classes: Sequence[int],
    width: int = 1280,
    photograph: bool = True,
) -> Image:
    """The labels of a frame in one picture, each object in one colour throughout.

    The photograph with 2D boxes (thin) and projected 3D boxes, the grid through the same camera,
    then from behind and above and as a map, and a list of the objects. Without ``photograph`` the
    boxes are drawn on the grid through the camera.
    """
    height, full_width = image_size_of(frame.image)
    size = (round(height * width / full_width), width)
    picture, calibration = load_picture(frame.image, frame.calibration, size)
    camera = (calibration.projection, calibration.lidar_to_camera)
    painted, palette = paint_objects(
        read_labels(frame), objects.voxels, objects.voxel_object, object_classes
    )
    grid, depth = render_with_depth(painted, size, camera, palette)
    boxed = _with_boxes(picture if photograph else grid, objects, camera, depth)
    rows = [boxed, grid] if photograph else [boxed]
    rows += [_space_row(painted, palette, objects.boxes3d_grid, width), _legend(objects, width)]
    return with_title(np.concatenate(rows), f"{frame.id}: {len(objects)} objects")


def _with_boxes(image: Image, objects: SceneObjects, camera: Camera, depth: np.ndarray) -> Image:
    colors = object_colors(len(objects))
    centers, half = objects.boxes_cxcywh[:, :2], objects.boxes_cxcywh[:, 2:] / 2
    size = (image.shape[0], image.shape[1])
    corners = [denormalize_pixels(corner, size) for corner in (centers - half, centers + half)]
    image = draw_boxes3d(image, objects.boxes3d_grid, colors, camera, depth)
    numbers = [str(number) for number in range(1, len(objects) + 1)]
    return draw_named_boxes(image, np.concatenate(corners, axis=1), colors, numbers, thickness=1)


def _space_row(
    painted: np.ndarray, palette: np.ndarray, boxes3d: Float[np.ndarray, "object 6"], width: int
) -> Image:
    """The grid with its boxes, raised view and map."""
    side = round(0.42 * width)
    size = (side, width - side - MARGIN)
    lines = object_colors(len(boxes3d)) // 2  # darker than the voxels that they are drawn on
    camera = raised_camera(size)
    raised, depth = render_with_depth(painted, size, camera, palette)
    raised = draw_boxes3d(raised, boxes3d, lines, camera, depth)
    bird = render_grid(painted, "bird", (side, side), palette=palette)
    bird = draw_boxes3d(bird, boxes3d, lines, bird_camera((side, side)))
    return np.concatenate([raised, np.tile(BACKGROUND, (side, MARGIN, 1)), bird], axis=1)


def _legend(objects: SceneObjects, width: int) -> Image:
    names = [
        f"{number} {CLASS_NAMES[class_id]} {visible:.0%}"
        for number, (class_id, visible) in enumerate(
            zip(objects.classes, objects.visible_fraction, strict=True), start=1
        )
    ]
    colors = np.concatenate([object_colors(len(objects)), UNCLAIMED[None]])
    return color_legend(width, [*names, "of no object"], colors, cell=178)


def describe(objects: SceneObjects) -> list[dict[str, Any]]:
    """The objects of a frame in ``labels.json``; boxes in metres of the grid frame."""
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
