"""Deformable decoder with iterative box refinement and the class, 2D box and 3D box heads."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from occdetr.geometry.camera import denormalize_pixels, unproject
from occdetr.models.decoder_layer import DecoderLayer
from occdetr.models.deformable_attention import Shapes
from occdetr.models.layers import (
    MLP,
    BoxHead,
    class_bias,
    inverse_sigmoid,
    sine_encoding,
)
from occdetr.models.query_selection import QuerySelection
from occdetr.structures import DetectorOutput, LayerDetections

# Depth of a 3D head that says zero, in (focal length / image height) metres: 15 m for KITTI.
UNIT_DEPTH = 8.0
MAX_EXPONENT = 4.0  # of log depth and log size: 0.3 to 800 m, far from overflow


class Detector(nn.Module):
    """The object detection module after the encoder (paper III-B): selection, decoder, heads."""

    def __init__(
        self,
        selection: QuerySelection,
        image_size: tuple[int, int],
        num_classes: int,
        hidden_dim: int,
        num_layers: int,
        num_heads: int,
        num_levels: int,
        num_points: int,
        feedforward_dim: int,
    ) -> None:
        super().__init__()
        self.selection = selection
        self.image_size = (int(image_size[0]), int(image_size[1]))
        self.num_frequencies = hidden_dim // 8
        self.position = MLP(hidden_dim, hidden_dim, hidden_dim, 2)
        self.layers = nn.ModuleList(
            DecoderLayer(hidden_dim, num_heads, num_levels, num_points, feedforward_dim)
            for _ in range(num_layers)
        )
        class_heads = [nn.Linear(hidden_dim, num_classes) for _ in self.layers]
        box_heads = [BoxHead(hidden_dim, hidden_dim, 4, 3) for _ in self.layers]
        box3d_heads = [BoxHead(hidden_dim, hidden_dim, 6, 3) for _ in self.layers]
        for class_head in class_heads:
            nn.init.constant_(class_head.bias, class_bias())
        self.class_heads = nn.ModuleList(class_heads)
        self.box_heads = nn.ModuleList(box_heads)
        self.box3d_heads = nn.ModuleList(box3d_heads)

    def forward(
        self,
        memory: Float[Tensor, "batch token dim"],
        shapes: Shapes,
        projection: Float[Tensor, "batch 3 4"],
        forced: Bool[Tensor, "batch token"] | None = None,
    ) -> DetectorOutput:
        """Detect; ``forced`` memory tokens are selected as queries before all others."""
        proposals, selected, query, reference = self.selection(memory, forced)
        layers = []
        for layer, class_head, box_head, box3d_head in zip(
            self.layers, self.class_heads, self.box_heads, self.box3d_heads, strict=True
        ):
            encoded = sine_encoding(reference, self.num_frequencies, max_frequency=128.0)
            query = layer(query, self.position(encoded), reference, memory, shapes)
            boxes = (inverse_sigmoid(reference) + box_head(query)).sigmoid()
            boxes3d = unproject_boxes3d(box3d_head(query), boxes, projection, self.image_size)
            layers.append(LayerDetections(class_head(query), boxes, boxes3d))
            reference = boxes.detach()
        return DetectorOutput(query, layers, proposals, selected)


def unproject_boxes3d(
    raw: Float[Tensor, "batch query 6"],
    boxes: Float[Tensor, "batch query 4"],
    projection: Float[Tensor, "batch 3 4"],
    image_size: tuple[int, int],
) -> Float[Tensor, "batch query 6"]:
    """The 3D head's parametrisation -> (centre, size) in the camera frame, metres.

    ``raw``: projected centre relative to the 2D box (in box sizes), log depth, log size. Depth is
    in units of the focal length, so that the same picture of the same object means the same size
    for any camera.
    """
    boxes = boxes.detach()
    center = boxes[..., :2] + raw[..., :2] * boxes[..., 2:]
    unit = UNIT_DEPTH * projection[:, 1, 1, None] / image_size[0]
    depth = unit * raw[..., 2].clamp(-MAX_EXPONENT, MAX_EXPONENT).exp()
    points = unproject(denormalize_pixels(center, image_size), depth, projection)
    return torch.cat([points, raw[..., 3:].clamp(-MAX_EXPONENT, MAX_EXPONENT).exp()], dim=-1)
