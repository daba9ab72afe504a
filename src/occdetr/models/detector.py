"""The detector: query selection, deformable decoder, class, 2D box and 3D box heads."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from occdetr.errors import BELOW_ONE, LAYERS, InputError, check_range
from occdetr.geometry.camera import Camera, denormalize_pixels, unproject
from occdetr.models.decoder_layer import DecoderLayer
from occdetr.models.layers import (
    MLP,
    AttentionSize,
    BoxHead,
    clamp_inward,
    class_bias,
    inverse_sigmoid,
    sine_encoding,
)
from occdetr.models.query_selection import QuerySelection
from occdetr.structures import DetectorOutput, LayerDetections, Memory

# Depth for an output of zero, in metres x focal length / image height: 15 m for KITTI.
UNIT_DEPTH = 8.0
MAX_EXPONENT = 4.0  # of log depth and log size: 0.3 to 800 m, far from overflow


class Detector(nn.Module):
    """The object detection module after the encoder (paper III-B).

    Queries are selected from the memory; each decoder layer refines their boxes (Deformable DETR's
    iterative box refinement) and has its own class, 2D box and 3D box head. ``update_position``:
    each layer gets the encoding of the refined boxes; otherwise all get that of the selected boxes
    (Deformable DETR). Raises InputError on values that are out of range or contradict each other.
    """

    def __init__(
        self,
        selection: QuerySelection,
        classes: Sequence[int],
        attention: AttentionSize,
        num_layers: int,
        dropout: float = 0.0,
        update_position: bool = True,
    ) -> None:
        super().__init__()
        hidden_dim = attention.hidden_dim
        check_range("model.detector.num_layers", num_layers, LAYERS)
        check_range("model.detector.dropout", dropout, BELOW_ONE)
        if hidden_dim % 8:
            raise InputError(
                f"attention.hidden_dim={hidden_dim}: give a multiple of 8, since a box is encoded "
                "by a sine and a cosine of each of its 4 numbers"
            )
        if selection.hidden_dim != hidden_dim:
            raise InputError(
                f"model.detector.selection.hidden_dim={selection.hidden_dim}: must be "
                f"attention.hidden_dim={hidden_dim}"
            )
        self.classes = list(classes)
        if self.classes != selection.classes:
            raise InputError(
                f"model.detector.classes={self.classes}: must be "
                f"model.detector.selection.classes={selection.classes}: set foreground_classes, "
                "which both follow"
            )
        self.selection = selection
        self.num_frequencies = hidden_dim // 8
        self.update_position = update_position
        self.position = MLP(hidden_dim, hidden_dim, hidden_dim, 2)
        self.layers = nn.ModuleList(
            DecoderLayer(attention, dropout=dropout) for _ in range(num_layers)
        )
        class_heads = [nn.Linear(hidden_dim, len(classes)) for _ in self.layers]
        box_heads = [BoxHead(hidden_dim, hidden_dim, 4, 3) for _ in self.layers]
        box3d_heads = [BoxHead(hidden_dim, hidden_dim, 6, 3) for _ in self.layers]
        for class_head in class_heads:
            nn.init.constant_(class_head.bias, class_bias())
        self.class_heads = nn.ModuleList(class_heads)
        self.box_heads = nn.ModuleList(box_heads)
        self.box3d_heads = nn.ModuleList(box3d_heads)

    def forward(
        self,
        memory: Memory,
        camera: Camera,
        forced: Bool[Tensor, "batch token"] | None = None,
    ) -> DetectorOutput:
        """Detect; ``forced`` memory tokens are selected as queries before all others."""
        proposals, selected, query, reference = self.selection(memory, forced)
        layers, position = [], self._encode(reference)
        for layer, class_head, box_head, box3d_head in zip(
            self.layers, self.class_heads, self.box_heads, self.box3d_heads, strict=True
        ):
            query = layer(query, position, reference, memory)
            boxes = (inverse_sigmoid(reference) + box_head(query)).sigmoid()
            boxes3d = unproject_boxes3d(box3d_head(query), boxes, camera)
            layers.append(LayerDetections(class_head(query), boxes, boxes3d))
            reference = boxes.detach()
            if self.update_position and len(layers) < len(self.layers):
                position = self._encode(reference)
        return DetectorOutput(query, layers, proposals, selected)

    def _encode(
        self, reference: Float[Tensor, "batch query 4"]
    ) -> Float[Tensor, "batch query dim"]:
        """The position encoding of reference boxes."""
        return self.position(sine_encoding(reference, self.num_frequencies, max_frequency=128.0))


def unproject_boxes3d(
    raw: Float[Tensor, "batch query 6"], boxes: Float[Tensor, "batch query 4"], camera: Camera
) -> Float[Tensor, "batch query 6"]:
    """The 3D head's output -> (centre, size) in the camera frame, metres.

    ``raw``: projected centre relative to the 2D box (in box sizes), log depth, log size. Depth is
    in units of the focal length over the image height, so that an object of a given size in the
    image has the same output for every camera.
    """
    boxes = boxes.detach()
    projection, image_size = camera.projection, camera.image_size
    center = boxes[..., :2] + raw[..., :2] * boxes[..., 2:]
    unit = UNIT_DEPTH * projection[:, 1, 1, None] / image_size[0]
    depth = unit * clamp_inward(raw[..., 2], MAX_EXPONENT).exp()
    points = unproject(denormalize_pixels(center, image_size), depth, projection)
    return torch.cat([points, clamp_inward(raw[..., 3:], MAX_EXPONENT).exp()], dim=-1)
