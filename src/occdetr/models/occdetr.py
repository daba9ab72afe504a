"""OccupancyDETR: the whole network, wired as the paper's overview figure (Fig. 2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from occdetr.geometry.boxes import enlarge_boxes3d, transform_boxes3d
from occdetr.geometry.voxels import VOXEL_SIZE
from occdetr.models.backbone import ResNet
from occdetr.models.deformable_attention import Shapes
from occdetr.models.detector import Detector
from occdetr.models.encoder import DeformableEncoder
from occdetr.models.fusion import Fusion
from occdetr.models.layers import take
from occdetr.models.mask_head import MaskHead
from occdetr.models.occupancy_decoder import OccupancyDecoder
from occdetr.structures import DetectorOutput, OccupancyOutput, SceneBatch, SceneOutput, Slots


class OccupancyDETR(nn.Module):
    """Camera image -> objects, and 256 x 256 x 32 semantic voxels.

    ``foreground_classes`` are the semantic ids that are detected. Partition ``all_background`` has
    no ``detector``, ``all_foreground`` no ``mask_head``. The ``num_slots`` best objects enter the
    occupancy decoder, their boxes enlarged by ``enlargement`` (paper: 1.5) but never so small that
    a cell of the object's grid would be finer than a voxel.
    """

    foreground_classes: Tensor

    def __init__(
        self,
        backbone: ResNet,
        encoder: DeformableEncoder,
        detector: Detector | None,
        occupancy_decoder: OccupancyDecoder,
        mask_head: MaskHead | None,
        fusion: Fusion,
        image_size: Sequence[int],
        foreground_classes: Sequence[int],
        num_slots: int,
        enlargement: float,
        slot_threshold: float,
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.encoder = encoder
        self.detector = detector
        self.occupancy_decoder = occupancy_decoder
        self.mask_head = mask_head
        self.fusion = fusion
        self.image_size = (int(image_size[0]), int(image_size[1]))
        classes = torch.tensor(tuple(foreground_classes), dtype=torch.long)
        self.register_buffer("foreground_classes", classes, persistent=False)
        self.num_slots = num_slots
        self.enlargement = enlargement
        self.min_box_size = 2 ** len(occupancy_decoder.layers) * VOXEL_SIZE
        self.slot_threshold = slot_threshold

    def forward(
        self,
        images: Float[Tensor, "batch 3 height width"],
        projection: Float[Tensor, "batch 3 4"],
        lidar_to_camera: Float[Tensor, "batch 4 4"],
    ) -> SceneOutput:
        memory, shapes = self.encode(images)
        detections = self.detect(memory, shapes, projection)
        slots = self.select_slots(detections, lidar_to_camera)
        occupancy = self.occupy(detections, slots, memory, shapes, projection, lidar_to_camera)
        return SceneOutput(detections, occupancy)

    @torch.no_grad()
    def predict(self, batch: SceneBatch) -> tuple[SceneOutput, UInt8[Tensor, "batch x y z"]]:
        """The network's output and the fused semantic grid of a batch."""
        output = self(batch.images, batch.projection, batch.lidar_to_camera)
        return output, self.fusion(output.occupancy)

    def encode(self, images: Tensor) -> tuple[Float[Tensor, "batch token dim"], Shapes]:
        return self.encoder(self.backbone(images))

    def detect(
        self,
        memory: Tensor,
        shapes: Shapes,
        projection: Tensor,
        forced: Bool[Tensor, "batch token"] | None = None,
    ) -> DetectorOutput | None:
        """Objects of the image, or None in partition ``all_background``."""
        if self.detector is None:
            return None
        return self.detector(memory, shapes, projection, forced)

    def select_slots(
        self,
        detections: DetectorOutput | None,
        lidar_to_camera: Tensor,
        forced: Bool[Tensor, "batch query"] | None = None,
    ) -> Slots | None:
        """The ``num_slots`` best objects, best first; ``forced`` queries before all others."""
        if detections is None:
            return None
        final = detections.final
        scores, classes = final.pred_logits.detach().sigmoid().max(-1)
        rank = scores if forced is None else scores + forced.to(scores.dtype)
        indices = rank.topk(self.num_slots, dim=1).indices
        boxes = final.pred_boxes3d.detach()
        boxes = boxes.gather(1, indices[..., None].expand(-1, -1, 6))
        boxes = transform_boxes3d(boxes, torch.linalg.inv(lidar_to_camera))
        boxes = enlarge_boxes3d(boxes, self.enlargement, self.min_box_size)
        classes = self.foreground_classes[classes.gather(1, indices)]
        return Slots(indices, scores.gather(1, indices), classes, boxes)

    def occupy(
        self,
        detections: DetectorOutput | None,
        slots: Slots | None,
        memory: Tensor,
        shapes: Shapes,
        projection: Tensor,
        lidar_to_camera: Tensor,
        forced: Bool[Tensor, "batch query"] | None = None,
    ) -> OccupancyOutput:
        """Occupancy of the objects and of the background, and the classes of the background."""
        if detections is None or slots is None:
            content = memory.new_zeros(len(memory), 0, memory.shape[-1])
            boxes, classes = (
                memory.new_zeros(len(memory), 0, 6),
                memory.new_zeros(len(memory), 0, 0),
            )
            used = torch.zeros(len(memory), 0, dtype=torch.bool, device=memory.device)
        else:
            content, boxes = take(detections.query_feat, slots.query_indices), slots.boxes3d
            classes = take(detections.final.pred_logits.sigmoid(), slots.query_indices)
            used = slots.scores >= self.slot_threshold
            if forced is not None:
                used = used | forced.gather(1, slots.query_indices)
        foreground, background = self.occupancy_decoder(
            content, boxes, classes, used, memory, shapes, projection, lidar_to_camera,
            self.image_size,
        )  # fmt: skip
        if self.mask_head is None or background is None:
            return OccupancyOutput(slots, foreground, [], None, None)
        mask_logits = self.mask_head(background.features, background.embedding)
        return OccupancyOutput(slots, foreground, background.levels, background.finest, mask_logits)
