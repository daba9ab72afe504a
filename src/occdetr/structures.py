"""What flows between the parts: batches, targets, outputs; only targets vary in shape."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor


class _Movable:
    """Moves every tensor of a dataclass: to a device, or to page-locked memory."""

    def to(self, device: Any, non_blocking: bool = False) -> Any:
        return _map_tensors(self, lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Any:
        return _map_tensors(self, lambda tensor: tensor.pin_memory())


def _map_tensors(value: Any, function: Any) -> Any:
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, list):
        return [_map_tensors(item, function) for item in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {
            f.name: _map_tensors(getattr(value, f.name), function)
            for f in dataclasses.fields(value)
        }
        return type(value)(**fields)
    return value


@dataclass
class SceneTarget(_Movable):
    """The objects of one frame; ``object`` may be 0, a normal frame.

    ``classes`` are semantic ids 1-19, ``boxes_cxcywh`` normalised image boxes clipped to the image,
    3D boxes are (centre, size) in metres, ``voxels`` indices (x, y, z) into the full grid,
    ``voxel_object`` the object each of them belongs to, ``roi_indices`` the preset ROI (memory
    token) that early matching assigned to each object.
    """

    classes: Int[Tensor, " object"]
    boxes_cxcywh: Float[Tensor, "object 4"]
    boxes3d_camera: Float[Tensor, "object 6"]
    boxes3d_grid: Float[Tensor, "object 6"]
    voxels: Shaped[Tensor, "voxel 3"]
    voxel_object: Int[Tensor, " voxel"]
    visible_fraction: Float[Tensor, " object"]
    roi_indices: Int[Tensor, " object"]

    def __len__(self) -> int:
        return len(self.classes)


@dataclass
class SceneBatch(_Movable):
    """Frames brought to the model's image size; no ``labels`` and ``targets`` in prediction.

    ``images`` are RGB, normalised with ImageNet's mean and deviation. ``projection`` maps camera
    coordinates (metres) to pixels of the resized image. ``frame_indices`` count the frames of the
    split, ``labels`` hold 0 empty, 1-19 semantic, 255 not evaluated.
    """

    images: Float[Tensor, "batch 3 height width"]
    projection: Float[Tensor, "batch 3 4"]
    lidar_to_camera: Float[Tensor, "batch 4 4"]
    frame_indices: Int[Tensor, " batch"]
    frame_ids: list[str]
    labels: UInt8[Tensor, "batch x y z"] | None = None
    targets: list[SceneTarget] | None = None

    def __len__(self) -> int:
        return len(self.images)


@dataclass
class Proposals:
    """What query selection sees: one class score and one refined ROI per memory token."""

    pred_logits: Float[Tensor, "batch token class"]
    pred_boxes: Float[Tensor, "batch token 4"]


@dataclass
class LayerDetections:
    """The three heads after one decoder layer; boxes normalised cxcywh, 3D boxes camera metres."""

    pred_logits: Float[Tensor, "batch query class"]
    pred_boxes: Float[Tensor, "batch query 4"]
    pred_boxes3d: Float[Tensor, "batch query 6"]


@dataclass
class DetectorOutput:
    """F_foreground (``query_feat``) and the heads of every decoder layer, the last one last."""

    query_feat: Float[Tensor, "batch query dim"]
    layers: list[LayerDetections]
    proposals: Proposals
    selected: Int[Tensor, "batch query"]

    @property
    def final(self) -> LayerDetections:
        return self.layers[-1]


@dataclass
class Slots:
    """The N objects that enter the occupancy decoder; unused slots have score 0.

    ``boxes3d`` are the enlarged boxes in the grid frame, centre and size in metres.
    """

    query_indices: Int[Tensor, "batch slot"]
    scores: Float[Tensor, "batch slot"]
    classes: Int[Tensor, "batch slot"]
    boxes3d: Float[Tensor, "batch slot 6"]


@dataclass
class BackgroundLevel:
    """Cells of one level with their occupancy logits.

    ``coordinates`` count cells of ``cell`` x ``cell`` x ``cell`` voxels.
    """

    coordinates: Int[Tensor, "batch candidate 3"]
    logits: Float[Tensor, "batch candidate"]
    cell: int


@dataclass
class OccupancyOutput:
    """What the mixed decoder and the mask head give.

    ``foreground_logits``: one small grid per slot, over the slot's enlarged box. ``levels``: what
    the background is supervised on, coarse to fine. ``voxels``: the finest cells, of the full grid,
    and ``mask_logits`` one logit per mask class and such voxel.
    """

    slots: Slots | None
    foreground_logits: Float[Tensor, "batch slot x y z"] | None
    levels: list[BackgroundLevel]
    voxels: BackgroundLevel | None
    mask_logits: Float[Tensor, "batch class voxel"] | None


@dataclass
class SceneOutput:
    """All that the network says of a batch."""

    detections: DetectorOutput | None
    occupancy: OccupancyOutput


def empty_target(device: torch.device | str = "cpu") -> SceneTarget:
    """The target of a frame without objects."""
    long = torch.zeros(0, dtype=torch.long, device=device)
    return SceneTarget(
        classes=long,
        boxes_cxcywh=torch.zeros(0, 4, device=device),
        boxes3d_camera=torch.zeros(0, 6, device=device),
        boxes3d_grid=torch.zeros(0, 6, device=device),
        voxels=torch.zeros(0, 3, dtype=torch.int16, device=device),
        voxel_object=long,
        visible_fraction=torch.zeros(0, device=device),
        roi_indices=long,
    )
