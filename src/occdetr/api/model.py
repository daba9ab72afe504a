"""A trained network as a function of an image and its camera."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray

from occdetr.api.camera import Camera
from occdetr.api.files import SUFFIXES, write_npz, write_ply
from occdetr.api.views import (
    View,
    boxes_in_grid,
    boxes_in_image,
    make_views,
    merge_grids,
    voxel_sources,
)
from occdetr.classes import CLASS_NAMES, IGNORE
from occdetr.data.dataset import SceneItem, collate, make_item
from occdetr.data.semantickitti import write_labels
from occdetr.drawing.panels import scene_panel
from occdetr.errors import SHARE, InputError, check_range
from occdetr.files import read_image, write_image
from occdetr.models.compilation import compile_network
from occdetr.models.inference import Prediction, predict
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.checkpoint import Checkpoint, restore_model
from occdetr.training.device import choose_device
from occdetr.training.run_checkpoint import BEST, LAST

#: IoU in the image from which two boxes of a class are the same object.
SAME_OBJECT = 0.6
LEAST_SEEN = 1e-3  # share of the grid's voxels in the image

RgbImage = UInt8[NDArray, "height width 3"]


@dataclass(frozen=True)
class Result:
    """What a network has found in an image.

    Attributes:
        image: RGB, in its own size.
        grid: class of each of 256 x 256 x 32 voxels of 0.2 m in the grid frame (x forward, y left,
            z up; its lower corner is at (0, -25.6, -2) metres): 0 empty, 1 to 19 as in
            ``occdetr.classes.CLASS_NAMES``; 255 where a warped image shows nothing. The grid of
            an image that was only resized (``views.make_views``) is predicted beyond it too.
        probabilities: that each voxel is occupied, from 0 to 1; NaN where ``grid`` is 255. A class
            is written above a threshold of its own, so that an occupied voxel may have a small one.
        boxes: 2D boxes (x1, y1, x2, y2) in pixels of the image; the centre of the first pixel is 0.
        boxes3d: centre and size in metres, along the axes of the grid frame.
        classes: class ids of the objects, best first.
        scores: from 0 to 1.
        camera: the image's.
        name: of the image.
    """

    image: RgbImage
    grid: UInt8[NDArray, "x y z"]
    probabilities: Float[NDArray, "x y z"]
    boxes: Float[NDArray, "object 4"]
    boxes3d: Float[NDArray, "object 6"]
    classes: Int[NDArray, " object"]
    scores: Float[NDArray, " object"]
    camera: Camera
    name: str = ""

    @property
    def class_names(self) -> list[str]:
        """The names of the objects' classes."""
        return [CLASS_NAMES[index] for index in self.classes]

    def picture(self) -> RgbImage:
        """The image with its boxes, and the grid below it."""
        objects = self.boxes, self.classes, self.scores
        return scene_panel(self.image, *objects, None, self.grid, title=self.name)

    def save(self, path: Path | str) -> None:
        """Write one file, whose suffix says what it holds.

        ``.png``: the picture. ``.label``: the grid as SemanticKITTI's raw ids (uint16, order x, y,
        z), 0 where it is not known. ``.npz``: all arrays of this object but the image. ``.ply``:
        the centres of the occupied voxels, in metres, in the colours of their classes.

        Raises ``InputError`` for another suffix.
        """
        file = Path(path)
        if file.suffix == ".png":
            write_image(file, self.picture())
        elif file.suffix == ".label":
            write_labels(file, np.where(self.grid == IGNORE, 0, self.grid).astype(np.uint8))
        elif file.suffix == ".npz":
            names = ("grid", "probabilities", "boxes", "boxes3d", "classes", "scores")
            write_npz(file, {name: getattr(self, name) for name in names})
        elif file.suffix == ".ply":
            write_ply(file, self.grid)
        else:
            raise InputError(f"{file}: give a file with {', '.join(SUFFIXES)}")

    def show(self) -> None:
        """Show the picture in a notebook. Raises ``InputError`` elsewhere."""
        shell = sys.modules.get("IPython")  # a notebook has loaded it
        if shell is None or shell.get_ipython() is None:
            raise InputError("show() needs a notebook: use save('result.png')")
        encoded = cv2.imencode(".png", self.picture()[..., ::-1])[1].tobytes()
        shell.display.display(shell.display.Image(data=encoded))


class Model:
    """A trained network: ``model(image, camera)`` gives a ``Result``; made by ``load``.

    ``merge_doubles``: IoU in the image from which the lower of two objects of a class is left out;
    None keeps all. The grid is not changed by it.
    """

    def __init__(
        self, network: OccupancyDETR, trained: Checkpoint, merge_doubles: float | None = SAME_OBJECT
    ) -> None:
        check_range("merge_doubles", merge_doubles, SHARE)
        self.network, self.trained, self.merge_doubles = network, trained, merge_doubles

    def __call__(self, image: Any, camera: Camera) -> Result:
        """The objects and the grid of an image: a file, or RGB bytes, an array [height, width, 3].

        Raises ``InputError`` if the file is missing or broken, or does not fit the camera.
        """
        name = ""
        if isinstance(image, (Path, str)):
            name, pixels = Path(image).name, read_image(Path(image))
        else:
            pixels = np.asarray(image)
            if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
                raise InputError(
                    f"image: {pixels.dtype} of shape {pixels.shape}: give RGB bytes of shape "
                    "(height, width, 3)"
                )
        return self.run(self.prepare(pixels, camera, name))

    def prepare(self, image: RgbImage, camera: Camera, name: str = "") -> Prepared:
        """The views of an image, for ``run``. It needs no device, so that it can run ahead.

        ``name`` is for titles and messages. Raises ``InputError`` as calling the model does.
        """
        views = make_views(image, camera, self.network.image_size)
        items = [make_item(view.image, view.camera, 0, name) for view in views]
        own = camera.for_image((image.shape[0], image.shape[1]))
        return Prepared(image, own, views, items, name)

    def run(self, prepared: Prepared) -> Result:
        """Run the network on the views of an image, one by one, and put them together.

        Raises ``InputError`` if a number of its output is not finite, or no view sees the grid.
        """
        device = next(self.network.parameters()).device
        batches = [collate([item]).to(device) for item in prepared.items]
        found = [predict(self.network, batch, probability=True)[0] for batch in batches]
        return self._together(prepared, found)

    def _together(self, prepared: Prepared, found: Sequence[Prediction]) -> Result:
        image, views = prepared.image, prepared.views
        size = (image.shape[0], image.shape[1])
        pairs = list(zip(views, found, strict=True))
        boxes = np.concatenate([boxes_in_image(v, p.boxes_xyxy, size) for v, p in pairs])
        boxes3d = np.concatenate([boxes_in_grid(v, p.boxes3d) for v, p in pairs])
        classes = np.concatenate([p.classes for p in found])
        scores = np.concatenate([p.scores for p in found])
        visible = np.flatnonzero((boxes[:, 2:] - boxes[:, :2] >= 1).all(1))
        order = visible[np.argsort(-scores[visible], kind="stable")]
        if self.merge_doubles is not None:
            order = order[
                _first_of_doubles(boxes[order], classes[order], scores[order], self.merge_doubles)
            ]
        sources = voxel_sources(views, prepared.camera)
        grid = merge_grids(sources, [p.grid for p in found], IGNORE)
        likely = [p.probability for p in found if p.probability is not None]
        if (grid != IGNORE).mean() < LEAST_SEEN:
            raise InputError(
                "the camera sees nothing of the grid, which is 51.2 m long ahead of the vehicle: "
                "check its yaw, height and pitch"
            )
        return Result(
            image=image,
            grid=grid,
            probabilities=merge_grids(sources, likely, np.nan),
            boxes=boxes[order],
            boxes3d=boxes3d[order],
            classes=classes[order],
            scores=scores[order],
            camera=prepared.camera,
            name=prepared.name,
        )


@dataclass(frozen=True)
class Prepared:
    """An image, its camera, its views, and the network's inputs of these."""

    image: RgbImage
    camera: Camera
    views: list[View]
    items: list[SceneItem]
    name: str = ""


def _first_of_doubles(
    boxes: Float[NDArray, "box 4"],
    classes: Int[NDArray, " box"],
    scores: Float[NDArray, " box"],
    iou: float,
) -> Int[NDArray, " kept"]:
    """The boxes that no better one of their class overlaps by more than ``iou``, in order."""
    sizes = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxesBatched(sizes.tolist(), scores.tolist(), classes.tolist(), 0.0, iou)
    return np.sort(np.asarray(kept, dtype=np.int64).reshape(-1))


def load(
    checkpoint: Path | str,
    device: str = "auto",
    score_threshold: float | None = None,
    compile: bool = False,
    allow: Sequence[str] = (),
    merge_doubles: float | None = SAME_OBJECT,
) -> Model:
    """A trained network.

    Args:
        checkpoint: the name of a model that comes with the package, as in ``"tiny"``, a file of a
            run, or a run's folder (its best checkpoint).
        device: ``auto`` (a GPU if there is one), ``cpu``, ``cuda`` or ``cuda:1``.
        score_threshold: least score of an object; None: the network's own.
        compile: use ``torch.compile``, which takes minutes at the first image.
        allow: modules of your own whose classes the checkpoint may name.
        merge_doubles: see ``Model``.

    Raises ``InputError`` if the file is missing, broken, or no checkpoint, or a value is wrong.
    """
    path = Path(checkpoint).expanduser()
    if path.is_dir():
        files = [path / BEST, path / LAST]
        path = next((file for file in files if file.is_file()), path)
        if path.is_dir():
            raise InputError(
                f"{path}: has neither {BEST} nor {LAST}: give a run's folder or a file"
            )
    check_range("score_threshold", score_threshold, SHARE)
    where = choose_device(device)
    network, trained = restore_model(path, allow)
    network.to(where)
    if compile:
        compile_network(network, where)
    if score_threshold is not None:
        network.fusion.score_threshold = float(score_threshold)
    return Model(network, trained, merge_doubles)
