"""What both stages of training share, as a LightningModule."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import lightning
import torch
from torch import Tensor

import occdetr
from occdetr.errors import InputError
from occdetr.evaluation.evaluator import SceneEvaluator, numbers
from occdetr.models.inference import Prediction, predict
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import SceneBatch
from occdetr.training.checkpoint import KEY, read_checkpoint, rebuild_model, section
from occdetr.training.instantiate import build_allowed
from occdetr.training.optimizer import OptimizerSettings, make_optimizer
from occdetr.training.scheduler import Constant, make_scheduler


class StageModule(lightning.LightningModule):
    """A network with an optimizer and a schedule; a stage adds its training and validation steps.

    ``Trainer.test`` measures detection and completion whatever the stage, and leaves all figures,
    tables included, in ``results``. ``Trainer.predict`` gives a list of ``Prediction`` a batch.

    Args:
        model: the network.
        optimizer: rates by part of the network.
        scheduler: how they change over the run, which must have an end.

    Raises ``InputError`` if the image has fewer tokens than the network has queries.
    """

    stage: ClassVar[str]

    def __init__(
        self, model: OccupancyDETR, optimizer: OptimizerSettings, scheduler: Constant
    ) -> None:
        super().__init__()
        check_queries(model)
        self.model = model
        self.optimizer_settings = optimizer
        self.scheduler_settings = scheduler
        self.evaluator = SceneEvaluator(model.image_size, detects=model.detector is not None)
        self.results: dict[str, Any] = {}

    def log_losses(self, losses: dict[str, Tensor], batch_size: int) -> Tensor:
        """Log every weighted term by name, and their sum, which is returned."""
        loss = torch.stack(list(losses.values())).sum()
        self.log_dict({f"loss/{k}": v.detach() for k, v in losses.items()}, batch_size=batch_size)
        self.log("loss/total", loss.detach(), batch_size=batch_size, prog_bar=True)
        return loss

    def on_validation_epoch_start(self) -> None:
        self.evaluator.reset()

    def on_test_epoch_start(self) -> None:
        self.evaluator.reset()

    def test_step(self, batch: SceneBatch, batch_idx: int) -> dict[str, Any]:
        """Count a batch; callbacks get the network's ``output`` and the fused ``grids``."""
        output, grids = self.evaluator.update(self.model, batch)
        return {"output": output, "grids": grids}

    def on_test_epoch_end(self) -> None:
        self.results = self.evaluator.compute()
        flat = {f"test/{k}": value for k, value in numbers(self.results).items()}
        self.log_dict(flat, rank_zero_only=True)

    def predict_step(self, batch: SceneBatch, batch_idx: int) -> list[Prediction]:
        """One ``Prediction`` for each image of a batch, which needs no labels."""
        return predict(self.model, batch)

    def configure_optimizers(self) -> Any:
        optimizer = make_optimizer(self.model, self.optimizer_settings)
        schedule = make_scheduler(optimizer, self.scheduler_settings, self.total_steps())
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def total_steps(self) -> int:
        """Optimizer steps of the whole run. Raises ``InputError`` if it has no end."""
        steps = self.trainer.estimated_stepping_batches
        if not math.isfinite(steps):
            raise InputError("trainer.max_epochs=-1: the schedule needs an end: give a number")
        return int(steps)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint[KEY] = {"stage": self.stage, "version": occdetr.__version__}

    @classmethod
    def load_from_checkpoint(
        cls,
        checkpoint_path: str | Path,
        map_location: torch.device | str = "cpu",
        allow: Sequence[str] = (),
    ) -> Self:
        """The module of a checkpoint with its trained network, also of older versions.

        Nothing but the file is needed. It is read with ``weights_only=True``, and its configuration
        is built from this package's own classes only, and those of the modules of ``allow``.

        Raises ``InputError`` as ``restore_model``, and if the checkpoint is of another stage.
        """
        checkpoint = read_checkpoint(checkpoint_path, allow)
        model = rebuild_model(checkpoint)
        section(checkpoint, "data")  # evaluation needs it
        try:
            module = build_allowed(section(checkpoint, "module"), allow, model=model)
        except InputError as error:
            raise InputError(f"checkpoint={checkpoint_path}: {error}") from error
        if not isinstance(module, cls):
            raise InputError(
                f"checkpoint={checkpoint_path}: it is of stage={checkpoint.stage}: "
                f"load it with {type(module).__name__}"
            )
        module.save_hyperparameters(checkpoint.config)
        return module.to(map_location)


def check_queries(model: OccupancyDETR) -> None:
    """Raises ``InputError`` if the image has fewer tokens than the network has queries."""
    if model.detector is None:
        return
    selection = model.detector.selection
    if len(selection.rois) < selection.num_queries:
        raise InputError(
            f"image_size={list(model.image_size)}: gives {len(selection.rois)} tokens, fewer than "
            f"the {selection.num_queries} queries: use a larger image or lower "
            "model.detector.selection.num_queries"
        )
