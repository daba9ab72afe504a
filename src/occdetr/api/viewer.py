"""Results as a recording for rerun (https://rerun.io), an optional package: a time line of frames
with image, boxes, camera and voxels."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from occdetr.api.camera import Camera
from occdetr.api.model import Result
from occdetr.classes import CLASS_COLORS, CLASS_NAMES, IGNORE
from occdetr.errors import InputError
from occdetr.files import check_folder, temporary_name
from occdetr.geometry.boxes import boxes3d_to_grid
from occdetr.geometry.voxels import VOXEL_SIZE, voxel_centers
from occdetr.models.inference import Prediction
from occdetr.models.normalization import denormalize_images
from occdetr.structures import SceneBatch

JPEG_QUALITY = 85


class Recording:
    """A file of rerun (``.rrd``) to which results are added, one a time step.

    It has its name when it is closed, so that an interrupted one leaves no half file. ``with
    Recording(file) as recording: recording.add(result)``; then ``rerun file``. Raises
    ``InputError`` if rerun is not installed, or the file cannot be written.
    """

    def __init__(self, file: Path | str) -> None:
        try:
            self.rerun: Any = importlib.import_module("rerun")
        except ImportError:
            raise InputError(
                "viewer=rerun: its package is not installed: pip install rerun-sdk"
            ) from None
        self.file = Path(file)
        if self.file.is_dir():
            raise InputError(f"{file}: is a folder: give a file, as in {self.file / 'drive.rrd'}")
        check_folder("recording", self.file.parent, writable=True)
        self.part = temporary_name(self.file)
        self.stream = self.rerun.RecordingStream("occdetr")
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.stream.save(str(self.part))
        self.number = 0
        classes = [
            self.rerun.AnnotationInfo(id=index, label=name, color=color.tolist())
            for index, (name, color) in enumerate(zip(CLASS_NAMES, CLASS_COLORS, strict=True))
        ]
        self._log("/", self.rerun.AnnotationContext(classes), static=True)
        self._log("/", self.rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.stream.disconnect()
            self.part.unlink(missing_ok=True)

    def close(self) -> None:
        """Write what is left, and give the file its name."""
        self.stream.disconnect()
        os.replace(self.part, self.file)

    def add_frame(self, batch: SceneBatch, frame: int, prediction: Prediction) -> None:
        """Add a frame of a data set, with its labels as the truth. The image is the network's."""
        pixels = denormalize_images(batch.images[frame, None])[0].permute(1, 2, 0)
        given = batch.camera
        pose = given.lidar_to_camera[frame].double().cpu().numpy()
        projection = given.projection[frame].double().cpu().numpy()
        boxes3d = boxes3d_to_grid(prediction.boxes3d.astype(np.float64), pose)
        result = Result(
            image=pixels.cpu().numpy(),
            grid=prediction.grid,
            probabilities=np.full(prediction.grid.shape, np.nan, np.float32),
            boxes=prediction.boxes_xyxy,
            boxes3d=boxes3d,
            classes=prediction.classes,
            scores=prediction.scores,
            camera=Camera(projection, given.image_size, grid_to_camera=pose),
            name=batch.frame_ids[frame],
        )
        self.add(result, None if batch.labels is None else batch.labels[frame].cpu().numpy())

    def add(self, result: Result, truth: UInt8[NDArray, "x y z"] | None = None) -> None:
        """Add a result as the next frame; ``truth``: the true grid, as ``result.grid``."""
        self.stream.set_time("frame", sequence=self.number)
        self.number += 1
        rr, camera = self.rerun, result.camera
        image = "world/camera/image" if camera.undistorted else "image"
        to_grid = np.linalg.inv(camera.centered().grid_to_camera)
        pose = rr.Transform3D(translation=to_grid[:3, 3], mat3x3=to_grid[:3, :3])
        self._log("world/camera", pose)
        if camera.undistorted:
            assert camera.projection is not None
            height, width = result.image.shape[:2]
            lens = rr.Pinhole(
                image_from_camera=camera.projection[:, :3], width=width, height=height
            )
            self._log(image, lens)
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        encoded = cv2.imencode(".jpg", result.image[..., ::-1], quality)[1].tobytes()
        self._log(image, rr.EncodedImage(contents=encoded, media_type="image/jpeg"))
        named = zip(result.class_names, result.scores, strict=True)
        labels = [f"{name} {score:.2f}" for name, score in named]
        flat, boxes3d = result.boxes.astype(np.float64), result.boxes3d.astype(np.float64)
        own = {"class_ids": result.classes, "labels": labels}
        corner, size = flat[:, :2] + 0.5, flat[:, 2:] - flat[:, :2]  # pixels from their edges
        self._log(f"{image}/objects", rr.Boxes2D(mins=corner, sizes=size, **own))
        boxes = rr.Boxes3D(centers=boxes3d[:, :3], half_sizes=boxes3d[:, 3:] / 2, **own)
        self._log("world/objects", boxes)
        self._log("world/voxels", self._voxels(result.grid))
        if truth is not None:
            self._log("truth/voxels", self._voxels(truth))

    def _voxels(self, grid: UInt8[NDArray, "x y z"]) -> Any:
        occupied = np.argwhere((grid != 0) & (grid != IGNORE))
        return self.rerun.Points3D(
            voxel_centers(occupied),
            class_ids=grid[tuple(occupied.T)].astype(np.uint16),
            radii=VOXEL_SIZE / 2,
        )

    def _log(self, name: str, value: Any, static: bool = False) -> None:
        self.stream.log(name, value, static=static)
