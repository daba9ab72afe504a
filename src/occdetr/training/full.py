"""``stage=full``: the whole network, end to end (paper III-D)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from occdetr.evaluation.evaluator import scalar_figures
from occdetr.losses.detection import DetectionCriterion
from occdetr.losses.matcher import Match
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.losses.targets import SceneTruth
from occdetr.models.backbone import has_statistics
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import DetectorOutput, SceneBatch, SceneTarget
from occdetr.training.checkpoint import KEY
from occdetr.training.optimizer import OptimizerSettings
from occdetr.training.scheduler import Constant
from occdetr.training.stage import StageModule, check_same_classes


class FullModule(StageModule):
    """Ordinary two-stage selection by score, Hungarian matching after every decoder layer.

    In training the matched queries enter the occupancy decoder before all others if the slots'
    ``matched_first`` is set, so that its foreground half is supervised from the first step on.
    ``freeze_statistics`` keeps the batch norms at the statistics that pretraining has gathered. A
    run that starts without any gathers them itself, to its end, also when it is interrupted and
    resumed.
    """

    stage = "full"

    def __init__(
        self,
        model: OccupancyDETR,
        detection_criterion: DetectionCriterion,
        occupancy_criterion: OccupancyCriterion,
        optimizer: OptimizerSettings,
        scheduler: Constant,
        freeze_statistics: bool,
    ) -> None:
        super().__init__(model, optimizer, scheduler)
        if model.detector is not None:
            classes, network = detection_criterion.foreground_classes, model.detector.classes
            check_same_classes("loss.detection.foreground_classes", classes, network)
            classes = occupancy_criterion.foreground_classes
            check_same_classes("loss.occupancy.foreground_classes", classes, network)
        if model.mask_head is not None:
            classes, network = occupancy_criterion.mask_classes, model.mask_head.classes
            check_same_classes("loss.occupancy.mask_classes", classes, network)
        self.detection_criterion = detection_criterion
        self.occupancy_criterion = occupancy_criterion
        self.freeze_statistics = freeze_statistics
        self.gathers: bool | None = None  # statistics; decided when training starts

    def on_fit_start(self) -> None:
        super().on_fit_start()
        if self.gathers is None:
            self.gathers = not has_statistics(self.model.get_submodule("backbone"))
        if self.gathers and self.freeze_statistics and self.trainer.is_global_zero:
            print("note: the batch norms have no statistics to freeze: they learn in this run")

    def on_train_batch_start(self, batch: SceneBatch, batch_idx: int) -> None:
        if self.freeze_statistics and not self.gathers:
            self.model.backbone.freeze_statistics()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        checkpoint[KEY]["gathers_statistics"] = self.gathers

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        self.gathers = checkpoint.get(KEY, {}).get("gathers_statistics")

    def training_step(self, batch: SceneBatch, batch_idx: int) -> Tensor:
        losses, thresholds = self.losses(batch), self.model.fusion.class_thresholds
        if thresholds is not None and self.occupancy_criterion.scene_sums is not None:
            thresholds.observe(*self.occupancy_criterion.scene_sums)
        return self.log_losses(losses, len(batch))

    def losses(self, batch: SceneBatch) -> dict[str, Tensor]:
        """Every weighted term of the paper's equation, by name."""
        model, truth = self.model, SceneTruth.of_batch(batch)
        memory = model.encode(batch.images)
        detections = model.detect(memory, batch.camera)
        losses: dict[str, Tensor] = {}
        slots, matches = None, []
        if detections is not None:
            losses, matches = self.detection_losses(detections, truth.targets)
            matched = matched_queries(detections, matches)
            slots = model.select_slots(detections, batch.camera, matched)
        occupancy = model.occupy(detections, slots, memory, batch.camera)
        return losses | self.occupancy_criterion(occupancy, truth, matches)

    def detection_losses(
        self, detections: DetectorOutput, targets: list[SceneTarget]
    ) -> tuple[dict[str, Tensor], list[Match]]:
        """Detection terms, and the last layer's matches."""
        criterion = self.detection_criterion
        *layers, proposals = criterion.match(detections.supervised, targets)
        return criterion(detections, targets, layers, proposals), layers[-1]

    def validation_step(self, batch: SceneBatch, batch_idx: int) -> dict[str, Any]:
        """Count a batch as ``test_step`` does, and give callbacks the same."""
        return self.test_step(batch, batch_idx)

    def on_validation_epoch_end(self) -> None:
        shown = {"val/mIoU", "val/IoU", "val/AP50"}
        for name, value in self.figures().items():
            self.log(name, value, prog_bar=name in shown)

    def figures(self) -> dict[str, Tensor]:
        self.results = self.evaluator.compute()
        return scalar_figures(self.results, "val")


def matched_queries(detections: DetectorOutput, matches: list[Match]) -> Tensor:
    """True at the queries [B, Q] that were matched to an object."""
    matched = torch.zeros_like(detections.selected, dtype=torch.bool)
    for frame, (queries, _) in enumerate(matches):
        matched[frame, queries] = True
    return matched
