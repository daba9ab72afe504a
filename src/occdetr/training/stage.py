"""What both stages of training share, as a LightningModule."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

import occdetr
from occdetr.errors import InputError
from occdetr.evaluation.evaluator import SceneEvaluator, numbers
from occdetr.losses.groups import grouped_losses
from occdetr.losses.normalization import mean_over_ranks
from occdetr.models.backbone import batch_norms, has_statistics
from occdetr.models.inference import Prediction, predict
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import SceneBatch
from occdetr.training.checkpoint import (
    HYPER_PARAMETERS,
    KEY,
    read_checkpoint,
    rebuild_model,
    section,
)
from occdetr.training.instantiate import build_allowed
from occdetr.training.nonfinite import LossTerms, NonFiniteStop
from occdetr.training.optimizer import (
    OptimizerSettings,
    check_parts,
    make_optimizer,
    moved_state,
)
from occdetr.training.renames import migrate
from occdetr.training.scheduler import Constant, Pace, make_scheduler


class StageModule(lightning.LightningModule):
    """A network with an optimizer and a schedule; a stage adds its training and validation steps.

    ``Trainer.test`` measures detection and completion whatever the stage, and leaves all figures,
    tables included, in ``results``; validation leaves those of the whole network there.
    ``Trainer.predict`` gives a list of ``Prediction`` a batch.

    Args:
        model: the network.
        optimizer: rates by part of the network.
        scheduler: how they change over the run, which must have an end.

    Raises ``InputError`` if a rate is for a part that the network does not have.
    """

    stage: ClassVar[str]

    def __init__(
        self, model: OccupancyDETR, optimizer: OptimizerSettings, scheduler: Constant
    ) -> None:
        super().__init__()
        check_parts(model, optimizer)
        self.model = model
        self.optimizer_settings = optimizer
        self.scheduler_settings = scheduler
        self.evaluator = SceneEvaluator(model.image_size, detects=model.detector is not None)
        self.results: dict[str, Any] = {}
        self.terms: LossTerms | None = None
        self.pace = Pace()
        self.resumed: Pace | None = None
        self.schedule_steps: float = 1  # without a Trainer there is one step

    def log_losses(self, losses: dict[str, Tensor], batch_size: int) -> Tensor:
        """Log every weighted term as ``loss_<group>/<term>``, and return their sum.

        The sums of the groups are ``loss/<group>``, that of all ``loss/total``. What is logged is
        the mean over all ranks; what is returned is this rank's.
        """
        stacked = torch.stack(list(losses.values()))
        loss, own = stacked.sum(), stacked.detach()
        self.terms = LossTerms(list(losses), own, mean_over_ranks(own))
        values, total = self.terms.of_ranks, self.terms.of_ranks.sum()
        self.log_dict(grouped_losses(losses, values), batch_size=batch_size)
        self.log("loss/total", total, batch_size=batch_size, prog_bar=True)
        return loss

    def on_fit_start(self) -> None:
        check_frozen_norms(self.model)

    def configure_callbacks(self) -> list[Callback]:
        """What every training has, whoever makes its Trainer."""
        return [NonFiniteStop()]

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
        self.pace = self._pace_of_run()
        self.schedule_steps = self.total_steps()
        optimizer = make_optimizer(self.model, self.optimizer_settings)
        steps, warmup = self.schedule_steps, self.scheduler_settings.warmup_steps
        if warmup >= steps and self.trainer.is_global_zero:
            print(
                f"note: scheduler.warmup_steps={warmup}: the run has {steps:g} steps, so that the "
                "rates never reach those of the optimizer"
            )
        schedule = make_scheduler(optimizer, self.scheduler_settings, steps, self.pace)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def total_steps(self) -> float:
        """Steps of the whole schedule (see ``Pace``). Raises ``InputError`` if it has no end."""
        steps = self.pace.total_steps(self.trainer.max_epochs or 1, self.trainer.max_steps)
        if not math.isfinite(steps):
            raise InputError("trainer.max_epochs=-1: the schedule needs an end: give a number")
        return steps

    def _pace_of_run(self) -> Pace:
        trainer = self.trainer
        if trainer.train_dataloader is None:
            trainer.fit_loop.setup_data()
        batches, together = trainer.num_training_batches, trainer.accumulate_grad_batches
        own = max(math.ceil(batches / together), 1) if math.isfinite(batches) else 1
        if self.resumed is None:
            return Pace(own)
        rate = self.resumed.steps_per_epoch / own
        return replace(self.resumed, rate=1 if rate == 1 else rate)

    def figures(self) -> dict[str, Tensor]:
        """What validation logs, by name; every stage has its own."""
        raise NotImplementedError(f"{type(self).__name__}.figures")

    def figure_names(self) -> list[str]:
        """The names of ``figures``, known before any frame is seen."""
        with warnings.catch_warnings(action="ignore"):  # of metrics without frames
            names = list(self.figures())
        self.evaluator.reset()
        self.results = {}
        return names

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        position = self.pace.position(self.global_step)
        schedule = {"steps_per_epoch": self.pace.steps_per_epoch, "position": position}
        checkpoint[KEY] = {
            "stage": self.stage,
            "version": occdetr.__version__,
            "schedule": schedule,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Continue the schedule of a run, and its optimizer with the settings of this one."""
        step = checkpoint["global_step"]
        schedule = checkpoint[KEY].get("schedule")
        if schedule is None:  # older versions: at the end of an epoch
            epochs = checkpoint["loops"]["fit_loop"]["epoch_progress"]["current"]["processed"]
            schedule = {"steps_per_epoch": max(step // max(epochs, 1), 1), "position": step}
        self.resumed = Pace(schedule["steps_per_epoch"], schedule["position"], step)
        saved = checkpoint.get(HYPER_PARAMETERS)
        if not saved:
            return  # of a Trainer without a configuration
        settings = build_allowed(migrate(saved)["module"]["optimizer"])
        if settings != self.optimizer_settings:
            states = checkpoint["optimizer_states"]
            states[0] = moved_state(self.model, states[0], settings, self.optimizer_settings)

    def on_train_start(self) -> None:
        """Rates of this run's settings, where a checkpoint has brought those of another."""
        if self.resumed is None:
            return
        optimizer: Any = self.optimizers(use_pl_optimizer=False)
        schedule: Any = self.lr_schedulers()
        schedule.base_lrs = [group["initial_lr"] for group in optimizer.param_groups]
        for group, factor in zip(optimizer.param_groups, schedule.lr_lambdas, strict=True):
            group["lr"] = group["initial_lr"] * factor(schedule.last_epoch)
        schedule._last_lr = [group["lr"] for group in optimizer.param_groups]

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


def check_frozen_norms(model: OccupancyDETR) -> None:
    """Raises ``InputError`` if the backbone keeps statistics that its batch norms do not have."""
    backbone = model.get_submodule("backbone")
    frozen = not all(norm.training for norm in batch_norms(backbone))
    if frozen and not has_statistics(backbone):
        raise InputError(
            "model.backbone.freeze_norm=true: its batch norms have no statistics to keep: give "
            "model.backbone.weights=imagenet or the path of its file, or freeze_norm=false"
        )


def check_same_classes(setting: str, classes: Sequence[int], network: Sequence[int]) -> None:
    """Raises ``InputError`` if a criterion has other classes than its part of the network."""
    if list(classes) != list(network):
        raise InputError(
            f"{setting}={list(classes)}: the network has {list(network)}: leave it out, it follows"
        )
