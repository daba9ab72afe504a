"""OccupancyDETR: the whole network, wired as in the paper's overview (Fig. 2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor, nn

from occdetr.classes import check_classes
from occdetr.geometry.camera import Camera, check_image_size
from occdetr.models import consistency
from occdetr.models.backbone import Backbone
from occdetr.models.detector import Detector
from occdetr.models.encoder import DeformableEncoder
from occdetr.models.fusion import Fusion
from occdetr.models.layers import take
from occdetr.models.mask_head import MaskHead
from occdetr.models.normalization import normalize_images
from occdetr.models.occupancy_decoder import OccupancyDecoder
from occdetr.models.occupancy_queries import ObjectQueries
from occdetr.models.slots import SlotSelection
from occdetr.structures import (
    DetectorOutput,
    Images,
    Memory,
    OccupancyOutput,
    SceneBatch,
    SceneOutput,
    Slots,
)


class OccupancyDETR(nn.Module):
    """Camera image -> objects, and 256 x 256 x 32 semantic voxels.

    ``foreground_classes`` are the semantic ids that are detected. Partition ``all_background`` has
    no ``detector``, ``all_foreground`` no ``mask_head``. ``image_size`` is (height, width).

    Raises InputError if the parts do not fit each other (``models.consistency``).
    """

    foreground_classes: Tensor

    def __init__(
        self,
        backbone: Backbone,
        encoder: DeformableEncoder,
        detector: Detector | None,
        slots: SlotSelection,
        occupancy_decoder: OccupancyDecoder,
        mask_head: MaskHead | None,
        fusion: Fusion,
        image_size: Sequence[int],
        foreground_classes: Sequence[int],
    ) -> None:
        super().__init__()
        check_classes("foreground_classes", foreground_classes)
        consistency.check_levels(backbone, encoder, detector, image_size)
        consistency.check_foreground(detector, slots, occupancy_decoder, foreground_classes)
        consistency.check_background(occupancy_decoder, mask_head, fusion, encoder.hidden_dim)
        self.backbone = backbone
        self.encoder = encoder
        self.detector = detector
        self.slots = slots
        self.occupancy_decoder = occupancy_decoder
        self.mask_head = mask_head
        self.fusion = fusion
        self.image_size = check_image_size("image_size", image_size)
        classes = torch.tensor(tuple(foreground_classes), dtype=torch.long)
        self.register_buffer("foreground_classes", classes, persistent=False)

    def forward(self, images: Images, camera: Camera) -> SceneOutput:
        """``images``: RGB bytes, or floats that ``normalize_images`` has given."""
        memory = self.encode(images)
        detections = self.detect(memory, camera)
        slots = self.select_slots(detections, camera)
        occupancy = self.occupy(detections, slots, memory, camera)
        return SceneOutput(detections, occupancy)

    @torch.no_grad()
    def predict(self, batch: SceneBatch) -> tuple[SceneOutput, UInt8[Tensor, "batch x y z"]]:
        """The network's output and the fused semantic grid of a batch."""
        output = self(batch.images, batch.camera)
        return output, self.fusion(output.occupancy)

    def encode(self, images: Images) -> Memory:
        """Multi-scale image features. ``images`` as for ``forward``."""
        return self.encoder(self.backbone(normalize_images(images)))

    def detect(
        self, memory: Memory, camera: Camera, forced: Bool[Tensor, "batch token"] | None = None
    ) -> DetectorOutput | None:
        """The objects of the image, or None in partition ``all_background``.

        ``forced`` memory tokens become queries whatever their score (early matching).
        """
        if self.detector is None:
            return None
        return self.detector(memory, camera, forced)

    def select_slots(
        self,
        detections: DetectorOutput | None,
        camera: Camera,
        matched: Bool[Tensor, "batch query"] | None = None,
    ) -> Slots | None:
        """The objects that enter the occupancy decoder (``SlotSelection.select``), if any."""
        if detections is None:
            return None
        return self.slots.select(detections, self.foreground_classes, camera, matched)

    def occupy(
        self,
        detections: DetectorOutput | None,
        slots: Slots | None,
        memory: Memory,
        camera: Camera,
    ) -> OccupancyOutput:
        """Occupancy of the objects and of the background, and the classes of the background."""
        objects = _object_queries(detections, slots, memory)
        foreground, background = self.occupancy_decoder(objects, memory, camera)
        if self.mask_head is None or background is None:
            return OccupancyOutput(slots, foreground, [], None, None)
        *earlier, mask_logits = self.mask_head(background.features, background.embedding)
        return OccupancyOutput(
            slots, foreground, background.levels, background.finest, mask_logits, earlier
        )


def _object_queries(
    detections: DetectorOutput | None, slots: Slots | None, memory: Memory
) -> ObjectQueries:
    """What the occupancy decoder gets for each slot; no slots without a detector."""
    if detections is None or slots is None:
        batch, dim = len(memory), memory.tokens.shape[-1]
        empty = memory.tokens.new_zeros
        used = torch.zeros(batch, 0, dtype=torch.bool, device=memory.tokens.device)
        return ObjectQueries(empty(batch, 0, dim), empty(batch, 0, 0), empty(batch, 0, 6), used)
    return ObjectQueries(
        query_feat=take(detections.query_feat, slots.query_indices),
        class_scores=take(detections.final.pred_logits.sigmoid(), slots.query_indices),
        boxes3d=slots.boxes3d,
        used=slots.used,
    )
