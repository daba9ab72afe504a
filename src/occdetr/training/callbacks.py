"""Callbacks of trainings (steps, validations) and evaluations (predictions, diagnosis)."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging
from torch import Tensor

from occdetr.data.semantickitti import write_labels
from occdetr.drawing.panels import contact_sheet, prediction_row, prediction_titles
from occdetr.errors import BELOW_ONE, NOT_NEGATIVE, check_range
from occdetr.evaluation.diagnosis import Diagnosis
from occdetr.files import write_image
from occdetr.models.inference import Prediction, decode
from occdetr.models.normalization import denormalize_images
from occdetr.structures import SceneBatch

SHEET_WIDTH = 1280  # pixels of a sheet of predictions


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


class WeightAveraging(EMAWeightAveraging):
    """Moving average of the weights, which validation and the run's files have.

    ``age`` is the mean age of what is averaged, as a share of the steps so far: 0.1 averages about
    the last fifth of them; 0.5 averages all weights since the start equally, which keeps some of
    what the network knew before (Izmailov et al., 2018; Wortsman et al., 2022). The average keeps
    at most ``decay`` of itself in a step, so that it is never older than about 1 / (1 - decay)
    steps. With ``decay`` from the first step on, the weights before training would still be a fifth
    of the average after 1,600 steps. Buffers are not averaged: class tables are buffers too, and an
    average of whole numbers is rounded down.

    Raises InputError if ``decay`` or ``age`` is not in [0, 1).
    """

    def __init__(self, decay: float = 0.999, age: float = 0.1) -> None:
        check_range("callbacks.ema.decay", decay, BELOW_ONE)
        check_range("callbacks.ema.age", age, BELOW_ONE)
        super().__init__(use_buffers=False)
        self._kwargs["avg_fn"] = functools.partial(_average, decay, age)


def _average(
    decay: float, age: float, average: Tensor, weights: Tensor, steps: Tensor | int
) -> Tensor:
    kept = age * (1 + int(steps)) / (1 + age * int(steps))
    return torch.lerp(weights, average, min(decay, kept))


class ValidationRecord(Callback):
    """Keeps the figures of every validation of a run, also when it is interrupted and resumed.

    ``validations``: ``step`` (steps so far) and the figures by their names without ``val/``.
    """

    def __init__(self) -> None:
        self.validations: list[dict[str, float]] = []

    def on_validation_end(self, trainer: lightning.Trainer, module: Any) -> None:
        if trainer.sanity_checking:
            return
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


class FirstFrames(Callback):
    """Calls ``use(batch, frame, prediction)`` for the first ``number`` frames of ``Trainer.test``.

    With several ranks they are those of the first one.
    """

    def __init__(self, number: int, use: Callable[[SceneBatch, int, Prediction], None]) -> None:
        check_range("pictures", number, NOT_NEGATIVE)
        self.number, self.use, self.count = number, use, 0

    def on_test_batch_end(
        self,
        trainer: lightning.Trainer,
        module: Any,
        outputs: Any,
        batch: SceneBatch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if not trainer.is_global_zero or self.count >= self.number:
            return
        predictions = decode(module.model, outputs["output"], outputs["grids"])
        for frame, prediction in enumerate(predictions[: self.number - self.count]):
            self.use(batch, frame, prediction)
            self.count += 1


class PredictionSheet(FirstFrames):
    """Draws the first ``number`` frames of ``Trainer.test`` into one picture: the image with boxes,
    the true and the predicted grid."""

    def __init__(self, file: Path, number: int) -> None:
        super().__init__(number, self.add_row)
        self.file, self.rows = file, list[np.ndarray]()

    def add_row(self, batch: SceneBatch, frame: int, prediction: Prediction) -> None:
        """Draw a frame of a batch."""
        assert batch.labels is not None
        image = denormalize_images(batch.images[frame, None])[0].permute(1, 2, 0).cpu().numpy()
        objects = (prediction.boxes_xyxy, prediction.classes)
        grids = (batch.labels[frame].cpu().numpy(), prediction.grid)
        self.rows.append(prediction_row(image, *objects, *grids, width=SHEET_WIDTH))

    def on_test_end(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        if self.rows:
            write_image(self.file, contact_sheet([prediction_titles(SHEET_WIDTH), *self.rows]))


class PredictionWriter(Callback):
    """Writes the grids of ``Trainer.test`` and ``Trainer.predict`` as the test server takes them.

    ``<folder>/sequences/NN/predictions/NNNNNN.label``; every rank writes its own frames.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_test_batch_end(
        self,
        trainer: lightning.Trainer,
        module: Any,
        outputs: Any,
        batch: SceneBatch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        for frame_id, grid in zip(batch.frame_ids, outputs["grids"].cpu().numpy(), strict=True):
            self.write(frame_id, grid)

    def on_predict_batch_end(
        self,
        trainer: lightning.Trainer,
        module: Any,
        outputs: Any,
        batch: SceneBatch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        for frame_id, prediction in zip(batch.frame_ids, outputs, strict=True):
            self.write(frame_id, prediction.grid)

    def write(self, frame_id: str, grid: np.ndarray) -> None:
        sequence, name = frame_id.split("/")
        folder = self.folder / "sequences" / sequence / "predictions"
        write_labels(folder / f"{name}.label", grid)


class DiagnosisCallback(Callback):
    """Runs a ``Diagnosis`` beside ``Trainer.test``; ``results`` holds its figures afterwards."""

    def __init__(self, diagnosis: Diagnosis) -> None:
        self.diagnosis = diagnosis
        self.results: dict[str, Any] = {}

    def on_test_epoch_start(self, trainer: lightning.Trainer, module: Any) -> None:
        self.diagnosis.to(module.device)
        self.diagnosis.reset()

    def on_test_batch_end(
        self,
        trainer: lightning.Trainer,
        module: Any,
        outputs: Any,
        batch: SceneBatch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        self.diagnosis.update(module.model, batch, outputs["output"], outputs["grids"])

    def on_test_epoch_end(self, trainer: lightning.Trainer, module: Any) -> None:
        self.results = self.diagnosis.compute()
