"""``stage=pretrain``: the detector alone, by early matching (paper III-B, III-D)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from occdetr.errors import SHARE, InputError, check_range
from occdetr.evaluation.evaluator import update_detection
from occdetr.losses.detection import DetectionCriterion
from occdetr.losses.matcher import Match, to_device, to_host
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import DetectorOutput, SceneBatch, SceneTarget
from occdetr.training.optimizer import OptimizerSettings
from occdetr.training.scheduler import Constant
from occdetr.training.stage import StageModule, check_same_classes


class PretrainModule(StageModule):
    """Trains backbone, encoder and detector.

    In the first ``early_matching_share`` of all steps the objects are matched to preset ROIs before
    the network runs: the matched tokens are forced into the query set, and the same assignment
    supervises the query selection and every decoder layer. In the rest, selection is by score and
    matching is Hungarian after every layer: two-stage Deformable DETR.

    Raises ``InputError`` for a model without detector and for a share outside [0, 1].
    """

    stage = "pretrain"

    def __init__(
        self,
        model: OccupancyDETR,
        detection_criterion: DetectionCriterion,
        optimizer: OptimizerSettings,
        scheduler: Constant,
        early_matching_share: float,
    ) -> None:
        super().__init__(model, optimizer, scheduler)
        if model.detector is None:
            raise InputError(
                "partition=all_background stage=pretrain: it has no objects to detect; "
                "pretrain with partition=mixed, or run stage=full init_from=scratch"
            )
        check_range("early_matching_share", early_matching_share, SHARE)
        classes, network = detection_criterion.foreground_classes, model.detector.classes
        check_same_classes("loss.detection.foreground_classes", classes, network)
        for part in (model.occupancy_decoder, model.mask_head):
            if part is not None:  # not trained here
                part.requires_grad_(False)
        self.detection_criterion = detection_criterion
        self.early_matching_share = early_matching_share

    def training_step(self, batch: SceneBatch, batch_idx: int) -> Tensor:
        return self.log_losses(self.losses(batch), len(batch))

    def losses(self, batch: SceneBatch) -> dict[str, Tensor]:
        """The terms of detection, of every layer and of the proposals."""
        assert batch.targets is not None
        output, layer_matches, proposal_matches = self.match(batch)
        return self.detection_criterion(output, batch.targets, layer_matches, proposal_matches)

    def match(self, batch: SceneBatch) -> tuple[DetectorOutput, list[list[Match]], list[Match]]:
        """Detect, and assign objects to the queries of each layer and to memory tokens."""
        assert batch.targets is not None
        targets, memory = batch.targets, self.model.encode(batch.images)
        early_steps = math.ceil(self.early_matching_share * self.schedule_steps)
        if self.pace.position(self.global_step) < early_steps:
            forced = matched_tokens(targets, memory.tokens.shape[1])
            output = self.model.detect(memory, batch.camera, forced)
            assert output is not None
            matches, proposals = early_matches(output.selected, targets)
            return output, [matches] * len(output.layers), proposals
        output = self.model.detect(memory, batch.camera)
        assert output is not None
        *layers, proposals = self.detection_criterion.match(output.supervised, targets)
        return output, layers, proposals

    def validation_step(self, batch: SceneBatch, batch_idx: int) -> None:
        memory = self.model.encode(batch.images)
        output = self.model.detect(memory, batch.camera)
        assert output is not None
        self.evaluator.finite.update(batch.frame_ids, output)
        detection = self.evaluator.detection
        update_detection(detection, output, self.model.foreground_classes, batch)

    def on_validation_epoch_end(self) -> None:
        self.evaluator.finite.compute()
        self.log_dict(self.figures(), prog_bar=True, sync_dist=False)

    def figures(self) -> dict[str, Tensor]:
        figures = self.evaluator.detection.compute()
        return {f"val/{k}": torch.tensor(v, dtype=torch.float32) for k, v in figures.items()}


def matched_tokens(targets: list[SceneTarget], num_tokens: int) -> Bool[Tensor, "batch token"]:
    """True at the memory tokens whose preset ROI was matched to an object."""
    device = targets[0].roi_indices.device
    forced = torch.zeros(len(targets), num_tokens + 1, dtype=torch.bool, device=device)
    for row, target in zip(forced, targets, strict=True):
        unmatched = target.roi_indices < 0  # the token that is added, and left out at the end
        row.index_fill_(0, target.roi_indices.masked_fill(unmatched, num_tokens), True)
    return forced[:, :-1]


def early_matches(
    selected: Int[Tensor, "batch query"], targets: list[SceneTarget]
) -> tuple[list[Match], list[Match]]:
    """Early matching in terms of queries, and of memory tokens.

    ``selected`` is the token that each query was. Objects beyond the number of queries have none
    and are left out of the first. What was selected goes to the host at once, and so do the matches
    come back.
    """
    tokens = to_host(torch.cat([selected.flatten(), *(t.roi_indices for t in targets)]))
    chosen, *rois = tokens.split([selected.numel(), *map(len, targets)])
    frames = list(zip(chosen.view(selected.shape), rois, strict=True))
    of_queries = [(query[:, None] == roi).nonzero().T for query, roi in frames]
    have = [(roi >= 0).nonzero().squeeze(1) for roi in rois]
    of_tokens = [torch.stack([roi[own], own]) for roi, own in zip(rois, have, strict=True)]
    found = to_device([*of_queries, *of_tokens], selected.device)
    return found[: len(targets)], found[len(targets) :]
