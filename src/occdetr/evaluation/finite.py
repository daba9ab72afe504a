"""Refusing figures of outputs that are not finite."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch import distributed as dist
from torchmetrics import Metric

from occdetr.errors import NonFiniteError
from occdetr.models.inference import NOT_FINITE, frames_not_finite
from occdetr.structures import DetectorOutput, OccupancyOutput


class FiniteOutputs(Metric):
    """Counts the frames of whose output a number is not finite.

    Metrics leave such numbers out without a word, or fail in libraries. Raises ``NonFiniteError``:
    in one process at once, over several ranks in ``compute``, which is where they can stop
    together.
    """

    full_state_update = False
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("count", default=torch.tensor(0), dist_reduce_fx="sum")

    def update(
        self,
        frame_ids: Sequence[str],
        detections: DetectorOutput | None,
        occupancy: OccupancyOutput | None = None,
    ) -> None:
        """Check the output of a batch."""
        found = frames_not_finite(frame_ids, detections, occupancy)
        if found and not (dist.is_available() and dist.is_initialized()):
            raise NonFiniteError(f"{', '.join(found)}: {NOT_FINITE}")
        self.count += len(found)

    def compute(self) -> None:
        """Raises ``NonFiniteError`` if any rank has counted a frame."""
        if self.count:
            raise NonFiniteError(f"{int(self.count)} frames: {NOT_FINITE}")
