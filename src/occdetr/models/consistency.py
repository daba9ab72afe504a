"""Settings of several parts of the network that must agree; checked where the parts meet.

Every function raises ``InputError``, which names a setting to change.
"""

from __future__ import annotations

from collections.abc import Sequence

from occdetr.errors import InputError
from occdetr.models.backbone import Backbone
from occdetr.models.detector import Detector
from occdetr.models.encoder import DeformableEncoder
from occdetr.models.fusion import Fusion
from occdetr.models.mask_head import MaskHead
from occdetr.models.occupancy_decoder import OccupancyDecoder
from occdetr.models.slots import SlotSelection


def check_levels(
    backbone: Backbone,
    encoder: DeformableEncoder,
    detector: Detector | None,
    image_size: Sequence[int],
) -> None:
    """The backbone's maps are the encoder's, and the memory's tokens have one preset ROI each.

    A backbone without ``channels`` (see ``Trunk``) is not compared.
    """
    expected = [projection.get_submodule("0").in_channels for projection in encoder.projections]
    channels: dict[int, int] | None = getattr(backbone, "channels", None)
    if channels is not None and [*channels.values()] != expected:
        raise InputError(
            f"model.encoder.in_channels={expected}: the backbone has {[*channels.values()]}, at "
            f"the strides {[*channels]}"
        )
    if detector is None:
        return
    layout, num_levels = detector.selection.layout, len(encoder.level_embed)
    strides = list(layout.strides)
    if len(strides) != num_levels:
        raise InputError(
            f"strides={strides}: give one for each of attention.num_levels={num_levels}"
        )
    if channels is not None and strides[: len(channels)] != [*channels]:
        raise InputError(
            f"model.backbone.strides={[*channels]}: the preset ROIs have {strides}: set strides, "
            "which both follow"
        )
    if tuple(layout.image_size) != tuple(image_size):
        raise InputError(
            f"model.image_size={list(image_size)}: the preset ROIs are of "
            f"{list(layout.image_size)}: set image_size, which both follow"
        )


def check_foreground(
    detector: Detector | None,
    slots: SlotSelection,
    decoder: OccupancyDecoder,
    foreground_classes: Sequence[int],
) -> None:
    """The detector has the foreground classes, and enough queries to fill the slots."""
    classes = list(foreground_classes)
    if detector is None and classes:
        raise InputError(
            f"model.detector=null: foreground_classes={classes} need a detector: use another "
            "partition, or foreground_classes=[]"
        )
    if detector is None:
        return
    for name, own in (("detector", detector), ("occupancy_decoder.objects", decoder.objects)):
        if list(own.classes) != classes:
            raise InputError(
                f"model.{name}.classes={list(own.classes)}: must be foreground_classes={classes}, "
                "which it follows: leave it out"
            )
    if slots.num_slots > detector.selection.num_queries:
        raise InputError(
            f"model.slots.num_slots={slots.num_slots}: more than the "
            f"{detector.selection.num_queries} queries that fill them: lower it, or raise "
            "model.detector.selection.num_queries"
        )


def check_background(
    decoder: OccupancyDecoder, mask_head: MaskHead | None, fusion: Fusion, hidden_dim: int
) -> None:
    """There is a mask head if there are background voxels, for the classes that are fused."""
    background = decoder.background
    names = {"model.mask_head": mask_head, "model.occupancy_decoder.background": background}
    absent = [name for name, part in names.items() if part is None]
    if len(absent) == 1:
        raise InputError(
            f"{absent[0]}=null: background voxels need {' and '.join(names)}: set both to null, "
            "as partition=all_foreground does, or none"
        )
    if mask_head is None or background is None:
        if fusion.classes:
            raise InputError(
                f"mask_classes={fusion.classes}: the network has no mask head for them: use "
                "another partition, or mask_classes=[]"
            )
        return
    if mask_head.classes != fusion.classes:
        raise InputError(
            f"model.mask_head.classes={mask_head.classes}: must be "
            f"model.fusion.mask_classes={fusion.classes}: set mask_classes, which both follow"
        )
    width = background.refine_dim or hidden_dim
    if mask_head.voxel_dim != width:
        refined = "model.occupancy_decoder.background.refine_dim"
        source = refined if background.refine_dim else "attention.hidden_dim"
        raise InputError(
            f"model.mask_head.voxel_dim={mask_head.voxel_dim}: the voxels have {width} channels "
            f"({source}): give that number"
        )
