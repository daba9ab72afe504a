"""Pictures in the loggers of a run: frames of every validation beside their truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger

from occdetr.drawing.boxes import Image
from occdetr.drawing.panels import comparison_panel, scene_column
from occdetr.errors import NOT_NEGATIVE, check_range
from occdetr.geometry.boxes import cxcywh_to_xyxy
from occdetr.models.inference import Prediction, decode
from occdetr.models.normalization import denormalize_images
from occdetr.structures import SceneBatch

SECTION = "val_pictures"


def picture_loggers(trainer: lightning.Trainer) -> list[Logger]:
    """The loggers that take pictures: TensorBoard's, MLflow's, those with Weights & Biases' method.

    There are none on ranks other than the first.
    """
    own = (TensorBoardLogger, MLFlowLogger)
    every = trainer.loggers if trainer.is_global_zero else []
    return [each for each in every if isinstance(each, own) or hasattr(each, "log_image")]


def log_picture(loggers: Sequence[Logger], name: str, picture: Image, step: int) -> None:
    """Give ``picture_loggers`` a picture."""
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(name, picture, step, dataformats="HWC")
        elif isinstance(logger, MLFlowLogger):
            logger.experiment.log_image(logger.run_id, picture, key=name, step=step)
        else:
            taking: Any = logger
            taking.log_image(name, [picture], step)


class PictureLogger(Callback):
    """The first ``num_frames`` of every validation: boxes and grid, predicted and true.

    They show what the validation has predicted; that of pretraining runs the detector alone, so
    there the whole network runs once more, on that batch. Without a logger that takes pictures
    nothing is drawn.
    """

    def __init__(self, num_frames: int = 1) -> None:
        check_range("callbacks.pictures.num_frames", num_frames, NOT_NEGATIVE)
        self.num_frames = num_frames

    def on_validation_batch_end(
        self,
        trainer: lightning.Trainer,
        module: Any,
        outputs: Any,
        batch: SceneBatch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        loggers = picture_loggers(trainer)
        if batch_idx or not loggers or not self.num_frames:
            return
        predicted = (
            (outputs["output"], outputs["grids"]) if outputs else module.model.predict(batch)
        )
        predictions = decode(module.model, *predicted)
        for frame, prediction in enumerate(predictions[: self.num_frames]):
            picture = prediction_panel(batch, frame, prediction)
            name = f"{SECTION}/{batch.frame_ids[frame].replace('/', '_')}"
            log_picture(loggers, name, picture, trainer.global_step)


def prediction_panel(batch: SceneBatch, frame: int, prediction: Prediction) -> Image:
    """One frame of a batch with labels as a picture: its truth, and beside it the prediction."""
    assert batch.labels is not None
    assert batch.targets is not None
    target, labels = batch.targets[frame], batch.labels[frame].cpu().numpy()
    image = denormalize_images(batch.images)[frame].permute(1, 2, 0).cpu().numpy()
    height, width = image.shape[:2]
    boxes = cxcywh_to_xyxy(target.boxes_cxcywh).cpu().numpy()
    boxes = boxes * [width, height, width, height] - 0.5
    classes = target.classes.cpu().numpy()
    truth = scene_column(image, boxes, classes, None, labels, "ground truth")
    found = (prediction.boxes_xyxy, prediction.classes, prediction.scores)
    predicted = scene_column(image, *found, prediction.grid, "prediction")
    return comparison_panel([truth, predicted], batch.frame_ids[frame])
