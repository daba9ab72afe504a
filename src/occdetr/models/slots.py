"""Which detected objects enter the occupancy decoder, and the boxes they get (paper III-C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Bool, Float, Int
from torch import Tensor

from occdetr.errors import COUNT, SHARE, Range, check_ranges
from occdetr.geometry.boxes import bounds_in_grid, boxes3d_to_grid, enlarge_boxes3d
from occdetr.geometry.camera import Camera
from occdetr.geometry.voxels import GRID_SIZE
from occdetr.structures import DetectorOutput, Slots

ENLARGEMENT = Range(0, 10, open_least=True)
BOX_SIZE = Range(0, max(GRID_SIZE))


@dataclass(frozen=True)
class SlotSelection:
    """The ``num_slots`` queries of the highest scores, with their boxes enlarged.

    Boxes grow by the factor ``enlargement`` (paper: 1.5), to at least ``min_box_size`` metres
    (paper: 0). A slot with a score below ``threshold`` is not attended to by other queries.
    ``box_transform``: how a box of the camera frame becomes one of the grid frame. "bounds": the
    bounds of its corners, as in all published figures of this project; "axes": the inverse of how
    the labels were made (``geometry.boxes.boxes3d_to_grid``). ``matched_first``: in training,
    queries matched to an object come before all others (paper: False, scores alone decide).
    Raises InputError on values out of range.
    """

    num_slots: int
    enlargement: float = 1.5
    min_box_size: float = 1.6
    threshold: float = 0.05
    box_transform: Literal["bounds", "axes"] = "bounds"
    matched_first: bool = True

    def __post_init__(self) -> None:
        check_ranges("model.slots", self, num_slots=COUNT, enlargement=ENLARGEMENT)
        check_ranges("model.slots", self, min_box_size=BOX_SIZE, threshold=SHARE)

    def select(
        self,
        detections: DetectorOutput,
        foreground_classes: Int[Tensor, " class"],
        camera: Camera,
        matched: Bool[Tensor, "batch query"] | None = None,
    ) -> Slots:
        """Fill the slots from the last decoder layer. In training ``matched`` marks the queries
        matched to an object: with ``matched_first`` they come before all others, and are always
        attended to."""
        if not self.matched_first:
            matched = None
        final = detections.final
        scores, classes = final.pred_logits.detach().sigmoid().max(-1)
        rank = scores if matched is None else scores + matched.to(scores.dtype)
        indices = rank.topk(self.num_slots, dim=1).indices
        boxes = final.pred_boxes3d.detach()
        boxes = boxes.gather(1, indices[..., None].expand(-1, -1, 6))
        to_grid = bounds_in_grid if self.box_transform == "bounds" else boxes3d_to_grid
        boxes = self.enlarge(to_grid(boxes, camera.lidar_to_camera))
        scores = scores.gather(1, indices)
        used = scores >= self.threshold
        if matched is not None:
            used = used | matched.gather(1, indices)
        return Slots(indices, scores, foreground_classes[classes.gather(1, indices)], boxes, used)

    def enlarge(self, boxes3d: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 6"]:
        """The boxes that the occupancy decoder would fill for objects with these boxes."""
        return enlarge_boxes3d(boxes3d, self.enlargement, self.min_box_size)
