"""The values that the parts exchange: batches, targets, outputs. Only targets vary in shape."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from occdetr.geometry.camera import Camera

#: RGB: bytes, or floats normalised with ImageNet's mean and standard deviation.
Images = UInt8[Tensor, "batch 3 height width"] | Float[Tensor, "batch 3 height width"]


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
    """The objects of one frame; there may be none.

    ``classes`` are semantic ids 1-19. ``boxes_cxcywh`` are normalised image boxes, clipped to the
    image. 3D boxes are (centre, size) in metres. ``voxels`` are indices (x, y, z) into the full
    grid, and ``voxel_object`` is the index of the object that each of them belongs to.
    ``roi_indices`` is the preset ROI (memory token) that early matching assigned to each object.
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
    """Frames at the model's image size; ``labels`` and ``targets`` are None in prediction.

    ``images`` are RGB bytes, which the network normalises on its device (floats: normalised
    already). ``camera`` holds one camera per frame, as tensors, for the resized images.
    ``frame_indices`` count the frames of the split. ``labels``: 0 empty, 1-19 semantic classes, 255
    not evaluated.
    """

    images: Images
    camera: Camera
    frame_indices: Int[Tensor, " batch"]
    frame_ids: list[str]
    labels: UInt8[Tensor, "batch x y z"] | None = None
    targets: list[SceneTarget] | None = None

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class Memory:
    """The encoder's output: image features of all levels, flattened level by level, row by row.

    ``shapes``: (rows, columns) of each level, finest first.
    """

    tokens: Float[Tensor, "batch token dim"]
    shapes: list[tuple[int, int]]

    def __len__(self) -> int:
        return len(self.tokens)

    def cell_sizes(self) -> Float[Tensor, "level 2"]:
        """Width and height of a cell of each level, normalised to the image."""
        full = self.tokens.new_full  # on the device: a copy from the host would wait for it
        cells = [torch.stack([full((), 1 / w), full((), 1 / h)]) for h, w in self.shapes]
        return torch.stack(cells)


@dataclass
class Proposals:
    """Output of the query selection: class logits and a box (normalised cxcywh) per token.

    ``refined``: whether the boxes are predicted; otherwise they are the preset ROIs.
    """

    pred_logits: Float[Tensor, "batch token class"]
    pred_boxes: Float[Tensor, "batch token 4"]
    refined: bool = True


@dataclass
class LayerDetections:
    """The three heads after one decoder layer.

    Boxes are normalised cxcywh, 3D boxes (centre, size) in metres in the camera frame.
    """

    pred_logits: Float[Tensor, "batch query class"]
    pred_boxes: Float[Tensor, "batch query 4"]
    pred_boxes3d: Float[Tensor, "batch query 6"]


@dataclass
class DetectorOutput:
    """``query_feat`` (F_foreground in the paper) and the heads of every decoder layer, in order.

    ``selected`` are the memory tokens that became the queries. ``proposals`` are for the loss: a
    network in evaluation mode gives none.
    """

    query_feat: Float[Tensor, "batch query dim"]
    layers: list[LayerDetections]
    proposals: Proposals | None
    selected: Int[Tensor, "batch query"]

    @property
    def final(self) -> LayerDetections:
        return self.layers[-1]

    @property
    def supervised(self) -> list[LayerDetections | Proposals]:
        """What the detection loss compares with the objects: the layers, then the proposals.

        Raises ValueError if there are no proposals.
        """
        if self.proposals is None:
            raise ValueError("a network in evaluation mode gives no proposals for the loss")
        return [*self.layers, self.proposals]


@dataclass
class Slots:
    """The detected objects that enter the occupancy decoder, in a fixed number of slots, best
    first.

    ``boxes3d`` are the enlarged boxes in the grid frame, (centre, size) in metres. ``used`` marks
    the slots that other queries may attend to.
    """

    query_indices: Int[Tensor, "batch slot"]
    scores: Float[Tensor, "batch slot"]
    classes: Int[Tensor, "batch slot"]
    boxes3d: Float[Tensor, "batch slot 6"]
    used: Bool[Tensor, "batch slot"]


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
    """Output of the mixed occupancy decoder and the mask head.

    ``foreground_logits``: one small grid per slot, over the slot's enlarged box. ``levels``: the
    candidates that the background loss supervises, coarse to fine. ``voxels``: the finest cells,
    which are voxels of the full grid. ``mask_logits``: one logit per mask class and such voxel;
    ``aux_mask_logits``: the same after each earlier layer of the mask head, if it gives them.
    """

    slots: Slots | None
    foreground_logits: Float[Tensor, "batch slot x y z"] | None
    levels: list[BackgroundLevel]
    voxels: BackgroundLevel | None
    mask_logits: Float[Tensor, "batch class voxel"] | None
    aux_mask_logits: list[Float[Tensor, "batch class voxel"]] = dataclasses.field(
        default_factory=list
    )


@dataclass
class SceneOutput:
    """The network's output for a batch."""

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
