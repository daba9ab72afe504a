"""Which part of a network costs most: each predicted part in turn is replaced by the truth.

The truth is what a network of the same design would predict without errors
(``upper_bound.UpperBound``), and fusion is the network's own, so that with every part true the
score is the upper bound. ``substitution.SubstitutedFrame`` defines the substitution of each part.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor, nn
from torchmetrics import Metric

from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.object_errors import FrameErrors, ObjectErrors
from occdetr.evaluation.substitution import (
    OBJECT_PARTS,
    PREDICTION_PARTS,
    SubstitutedFrame,
)
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.losses.targets import SceneTruth
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import SceneBatch, SceneOutput

PREDICTED, TOGETHER = "as predicted", "up to "  # names of variants, beside those of the parts
NO_OBJECTS = {"objects": {}, "lost": {}, "invented": {}}
SCORES = ("mIoU", "mIoU_present", "IoU", "precision", "recall", "per_class")


class Diagnosis(nn.Module):
    """Scores of a network with each part true alone, and with all parts up to each one true.

    ``parts`` are those that the network has: no objects in partition ``all_background``, no
    background in ``all_foreground``.
    """

    def __init__(self, model: OccupancyDETR, criterion: OccupancyCriterion) -> None:
        super().__init__()
        self.criterion = criterion
        present = {True: model.detector is not None, False: model.mask_head is not None}
        self.parts = [part for part in PREDICTION_PARTS if present[part in OBJECT_PARTS]]
        alone = {part: [part] for part in self.parts}
        together = {TOGETHER + part: self.parts[: i + 1] for i, part in enumerate(self.parts)}
        self.variants: dict[str, list[str]] = {PREDICTED: [], **alone, **together}
        del self.variants[TOGETHER + self.parts[0]]  # it is that part alone
        self.completion = nn.ModuleList(SemanticSceneCompletion() for _ in self.variants)
        self.errors = ObjectErrors(model.foreground_classes) if model.detector is not None else None

    @torch.no_grad()
    def update(
        self,
        model: OccupancyDETR,
        batch: SceneBatch,
        output: SceneOutput,
        grids: UInt8[Tensor, "batch x y z"],
    ) -> None:
        """Count a batch with labels and targets, and what ``model.predict`` returned for it."""
        truth = SceneTruth.of_batch(batch)
        for index in range(len(truth)):
            frame = SubstitutedFrame(model, self.criterion, truth, output, index)
            grid, labels = grids[index : index + 1], frame.truth.labels
            for metric, parts in zip(self._metrics(), self.variants.values(), strict=True):
                metric.update(frame.fuse(parts) if parts else grid, labels)
            if self.errors is not None and frame.written is not None:
                errors = FrameErrors(
                    written=frame.written,
                    target=frame.target,
                    outcomes=frame.outcomes(),
                    owner=frame.truth.owner[0],
                    writer=frame.writer(),
                )
                self.errors.update(errors, grid[0], labels[0])

    def _metrics(self) -> list[SemanticSceneCompletion]:
        """The metrics of the variants, in their order."""
        return [metric for metric in self.modules() if isinstance(metric, SemanticSceneCompletion)]

    def reset(self) -> None:
        for metric in self.modules():
            if isinstance(metric, Metric):
                metric.reset()

    def compute(self) -> dict[str, Any]:
        """Over all ranks: the scores "as_predicted", with each part true "alone", and "together"
        with all parts before it; the figures of ``ObjectErrors``; ``advice``."""
        every = dict(zip(self.variants, [m.compute() for m in self._metrics()], strict=True))
        scores = {name: {key: found[key] for key in SCORES} for name, found in every.items()}
        first = scores[self.parts[0]]
        results = {
            "num_frames": every[PREDICTED]["num_frames"],
            "as_predicted": scores[PREDICTED],
            "alone": {part: scores[part] for part in self.parts},
            "together": {part: scores.get(TOGETHER + part, first) for part in self.parts},
            **(self.errors.compute() if self.errors is not None else NO_OBJECTS),
        }
        return {**results, "advice": advice(results)}


def advice(results: dict[str, Any]) -> str:
    """One sentence: the part whose truth alone gains most mIoU, and its most important errors."""
    before = results["as_predicted"]["mIoU"]
    alone = {part: scores["mIoU"] - before for part, scores in results["alone"].items()}
    part = max(alone, key=lambda name: alone[name])
    if alone[part] <= 0:
        return "No part alone would raise the mIoU: see which of them do together."
    after = results["alone"][part]["mIoU"]
    gain = f"Work on the {part}: its truth alone would raise the mIoU from {100 * before:.2f} to "
    outcomes: Counter[str] = sum(map(Counter, results["objects"].values()), Counter())
    number = outcomes.total() - outcomes["false"]
    found = f"of {number - outcomes['missed']} objects found"
    detail = {
        "detections": f" (of {number} objects {outcomes['missed']} are missed and "
        f"{outcomes['wrong class']} have a wrong class; {outcomes['false']} detections are false)",
        "3D boxes": f" ({found} {outcomes['wrong place']} are in a wrong place)",
        "object occupancy": f" ({found} {outcomes['wrong shape']} have a wrong shape)",
    }
    return f"{gain}{100 * after:.2f} %{detail.get(part, '')}."
