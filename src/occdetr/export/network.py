"""What is exported: from an image and its camera to a grid and objects, as tensors alone."""

from __future__ import annotations

import copy

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from occdetr.geometry.boxes import cxcywh_to_xyxy
from occdetr.geometry.camera import Camera
from occdetr.models.occdetr import OccupancyDETR

INPUTS = ("image", "projection", "lidar_to_camera")
OBJECTS = ("boxes_xyxy", "boxes3d", "scores", "classes")
OUTPUTS: tuple[str, ...] = ("grid", *OBJECTS)


class ImageToGrid(nn.Module):
    """A network with its fusion, for one image.

    ``labels`` is the type in which the grid is computed before it becomes bytes; TensorRT has no
    bytes but at its inputs and outputs, and makes them of floats.
    """

    def __init__(self, model: OccupancyDETR, labels: torch.dtype = torch.uint8) -> None:
        super().__init__()
        self.model = model
        self.fusion = copy.deepcopy(model.fusion)  # has no weights
        self.fusion.mask_classes = self.fusion.mask_classes.to(labels)

    @property
    def output_names(self) -> tuple[str, ...]:
        return OUTPUTS if self.model.detector is not None else OUTPUTS[:1]

    def forward(
        self,
        image: UInt8[Tensor, "1 3 height width"],
        projection: Float[Tensor, "1 3 4"],
        lidar_to_camera: Float[Tensor, "1 4 4"],
    ) -> tuple[Tensor, ...]:
        """``OUTPUTS``, or the grid alone in a partition without objects.

        They are bytes (1, 256, 256, 32); for all queries, in no order: 2D boxes in pixels of this
        image, 3D boxes (centre, size) in metres in the camera frame, scores from 0 to 1, semantic
        ids.
        """
        camera = Camera(projection, lidar_to_camera, self.model.image_size)
        output = self.model(image, camera)
        grid = self.fusion(output.occupancy).to(torch.uint8)
        if output.detections is None:
            return (grid,)
        final = output.detections.final
        scores, classes = final.pred_logits.sigmoid().max(-1)
        height, width = self.model.image_size
        size = final.pred_boxes.new_tensor([width, height, width, height])
        boxes = cxcywh_to_xyxy(final.pred_boxes) * size - 0.5
        return grid, boxes, final.pred_boxes3d, scores, self.model.foreground_classes[classes]
