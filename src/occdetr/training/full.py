"""``stage=full``: the whole network, end to end (paper III-D)."""

from __future__ import annotations

import torch
from torch import Tensor

from occdetr.evaluation.evaluator import scalar_figures
from occdetr.losses.detection import DetectionCriterion
from occdetr.losses.matcher import Match
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import DetectorOutput, SceneBatch
from occdetr.training.optimizer import OptimizerSettings
from occdetr.training.scheduler import Constant
from occdetr.training.stage import StageModule


class FullModule(StageModule):
    """Ordinary two-stage selection by score, Hungarian matching after every decoder layer.

    In training the matched queries enter the occupancy decoder before all others, so that its
    foreground half is supervised from the first step on. ``freeze_statistics`` keeps the batch
    norms at the statistics that pretraining has gathered.
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
        self.detection_criterion = detection_criterion
        self.occupancy_criterion = occupancy_criterion
        self.freeze_statistics = freeze_statistics

    def on_train_batch_start(self, batch: SceneBatch, batch_idx: int) -> None:
        if self.freeze_statistics:
            self.model.backbone.freeze_statistics()

    def losses(self, batch: SceneBatch) -> dict[str, Tensor]:
        """Every weighted term of the paper's equation, by name."""
        assert batch.targets is not None
        assert batch.labels is not None
        model = self.model
        memory, shapes = model.encode(batch.images)
        detections = model.detect(memory, shapes, batch.projection)
        losses: dict[str, Tensor] = {}
        slots, forced, matches = None, None, []
        if detections is not None:
            losses, matches = self.detection_losses(detections, batch)
            forced = matched_queries(detections, matches)
            slots = model.select_slots(detections, batch.lidar_to_camera, forced)
        occupancy = model.occupy(
            detections, slots, memory, shapes, batch.projection, batch.lidar_to_camera, forced
        )
        return losses | self.occupancy_criterion(occupancy, batch.labels, batch.targets, matches)

    def detection_losses(
        self, detections: DetectorOutput, batch: SceneBatch
    ) -> tuple[dict[str, Tensor], list[Match]]:
        """Detection terms, and the last layer's matches."""
        criterion, targets = self.detection_criterion, batch.targets
        assert targets is not None
        layers = [criterion.match(layer, targets) for layer in detections.layers]
        proposals = criterion.match(detections.proposals, targets)
        return criterion(detections, targets, layers, proposals), layers[-1]

    def on_validation_epoch_start(self) -> None:
        self.evaluator.reset()

    def validation_step(self, batch: SceneBatch, batch_idx: int) -> None:
        self.evaluator.update(self.model, batch)

    def on_validation_epoch_end(self) -> None:
        figures = scalar_figures(self.evaluator.compute(), "val")
        shown = {"val/mIoU", "val/IoU", "val/AP50"}
        for name, value in figures.items():
            self.log(name, value, prog_bar=name in shown)


def matched_queries(detections: DetectorOutput, matches: list[Match]) -> Tensor:
    """True at the queries [B, Q] that were matched to an object."""
    forced = torch.zeros_like(detections.selected, dtype=torch.bool)
    for frame, (queries, _) in enumerate(matches):
        forced[frame, queries] = True
    return forced
