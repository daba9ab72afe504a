"""What every training logs beside its losses: pace, gradient norm, validations, pictures."""

from __future__ import annotations

import time
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from occdetr.data.images import denormalize_image
from occdetr.drawing.panels import scene_panel
from occdetr.geometry.boxes import cxcywh_to_xyxy
from occdetr.structures import SceneBatch, SceneOutput


class StepMonitor(Callback):
    """Logs ``optim/lr``, ``optim/grad_norm`` (before clipping) and ``time/step`` in seconds."""

    def __init__(self) -> None:
        self.started = time.perf_counter()

    def on_train_batch_start(self, trainer: Any, module: Any, batch: Any, batch_idx: int) -> None:
        self.started = time.perf_counter()

    def on_before_optimizer_step(self, trainer: Any, module: Any, optimizer: Any) -> None:
        gradients = [p.grad for p in module.parameters() if p.grad is not None]
        module.log("optim/grad_norm", torch.nn.utils.get_total_norm(gradients))
        module.log("optim/lr", optimizer.param_groups[0]["lr"])

    def on_train_batch_end(self, trainer: Any, module: Any, *args: Any) -> None:
        module.log("time/step", time.perf_counter() - self.started)


class ValidationRecord(Callback):
    """Keeps the figures of every validation of a run, also over an interruption.

    ``validations``: ``step`` (steps so far) and the figures by their names without ``val/``.
    """

    def __init__(self) -> None:
        self.validations: list[dict[str, float]] = []

    def on_validation_end(self, trainer: lightning.Trainer, module: Any) -> None:
        figures = {
            name.removeprefix("val/"): float(value)
            for name, value in trainer.callback_metrics.items()
            if name.startswith("val/")
        }
        self.validations.append({"step": trainer.global_step, **figures})

    def state_dict(self) -> dict[str, Any]:
        return {"validations": self.validations}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.validations = list(state_dict["validations"])


class PictureLogger(Callback):
    """Once per validation epoch: boxes on the picture, true and predicted grid, in TensorBoard."""

    def __init__(self, num_frames: int = 1) -> None:
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
        logger = trainer.logger
        if batch_idx or not trainer.is_global_zero or not isinstance(logger, TensorBoardLogger):
            return
        output, grids = module.model.predict(batch)
        for frame in range(min(self.num_frames, len(batch))):
            picture = prediction_panel(module.model, batch, output, grids, frame)
            name = f"val/{batch.frame_ids[frame].replace('/', '_')}"
            logger.experiment.add_image(name, picture, trainer.global_step, dataformats="HWC")


def prediction_panel(
    model: Any, batch: SceneBatch, output: SceneOutput, grids: Tensor, frame: int
) -> np.ndarray:
    """One frame of a batch as a picture: boxes above the score threshold, truth, prediction."""
    image = denormalize_image(batch.images[frame])
    found = detections_of(model, output, frame)
    height, width = image.shape[:2]
    boxes = found["boxes_xyxy"] * [width, height, width, height] - 0.5
    truth = None if batch.labels is None else batch.labels[frame].cpu().numpy()
    return scene_panel(
        image, boxes, found["classes"], found["scores"], truth, grids[frame].cpu().numpy(),
        title=batch.frame_ids[frame],
    )  # fmt: skip


def detections_of(model: Any, output: SceneOutput, frame: int) -> dict[str, np.ndarray]:
    """Detections of a frame above the fusion's score threshold.

    ``boxes_xyxy`` normalised [N, 4], ``boxes3d`` camera frame, metres [N, 6], ``classes`` semantic
    ids [N], ``scores`` [N]; best first.
    """
    if output.detections is None:
        return {
            "boxes_xyxy": np.zeros((0, 4), np.float32),
            "boxes3d": np.zeros((0, 6), np.float32),
            "classes": np.zeros(0, np.int64),
            "scores": np.zeros(0, np.float32),
        }
    final = output.detections.final
    scores, classes = final.pred_logits[frame].float().sigmoid().max(-1)
    order = scores.argsort(descending=True)
    order = order[scores[order] > model.fusion.score_threshold]
    found = {
        "boxes_xyxy": cxcywh_to_xyxy(final.pred_boxes[frame].float())[order],
        "boxes3d": final.pred_boxes3d[frame].float()[order],
        "classes": model.foreground_classes[classes][order],
        "scores": scores[order],
    }
    return {name: value.cpu().numpy() for name, value in found.items()}
