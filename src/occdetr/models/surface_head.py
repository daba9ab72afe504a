"""What each pixel sees, and what that says of places in space; beyond the paper.

A cell of space that is occupied and in view is the first surface on some pixel's ray. So the
memory's finest level is taught, from the labels alone, how far away that surface is and of what
class; and each box of the occupancy decoder is told of which class the surface is, and with which
probability it lies nearer than the box's front, its back, and some steps before and behind them.
Without this, cells on one ray differ only by their box encoding
(compare depth-aware lifting in BEVDepth, Li et al., 2023, and its LiDAR supervision).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.classes import NUM_CLASSES
from occdetr.geometry.camera import MIN_DEPTH, normalize_pixels, project_points, transform_points
from occdetr.geometry.depths import depth_position, depth_unit
from occdetr.models.deformable_attention import Shapes
from occdetr.models.layers import MLP
from occdetr.structures import SurfaceOutput

#: Where the probability is asked for: intervals of depth before a box's front, and behind its back.
STEPS = (0.0, 4.0, 12.0)
EVIDENCE = 2 * len(STEPS) + NUM_CLASSES - 1


class SurfaceHead(nn.Module):
    """Depth and class of the first surface on the ray of each token of the finest level.

    Depth is one of ``num_depths`` intervals of equal ratio, or beyond them (or nowhere).
    """

    def __init__(self, hidden_dim: int, num_depths: int, num_classes: int) -> None:
        super().__init__()
        self.num_depths, self.num_classes = num_depths, num_classes
        self.mlp = MLP(hidden_dim, hidden_dim, num_depths + 1 + num_classes, 2)

    def forward(self, memory: Float[Tensor, "batch token dim"], shapes: Shapes) -> SurfaceOutput:
        rows, columns = shapes[0]
        logits = self.mlp(memory[:, : rows * columns]).transpose(1, 2)
        logits = logits.unflatten(2, (rows, columns))
        depths, classes = logits.split([self.num_depths + 1, self.num_classes], dim=1)
        return SurfaceOutput(depths, classes)


@torch.no_grad()
def surface_evidence(
    surface: SurfaceOutput,
    boxes: Float[Tensor, "batch box 6"],
    projection: Float[Tensor, "batch 3 4"],
    lidar_to_camera: Float[Tensor, "batch 4 4"],
    image_size: tuple[int, int],
) -> Float[Tensor, "batch box evidence"]:
    """What the surface seen at a box's projection is: the probabilities that it is nearer than some
    depths around the box (``STEPS``), then those of its classes; zeros for boxes out of view.
    Boxes are centre and size, grid frame, metres.
    """
    with torch.autocast(boxes.device.type, enabled=False):
        nearer = surface.depth_logits.float().softmax(1).cumsum(1)[:, :-1]
        nearer = F.pad(nearer, (0, 0, 0, 0, 1, 0))[:, None]  # B, 1, edge, row, column
        edges, rows, columns = nearer.shape[2] - 1, *nearer.shape[3:]
        points = transform_points(boxes[..., :3].float(), lidar_to_camera.float())
        pixels, depth = project_points(points, projection.float())
        place = normalize_pixels(pixels, image_size)
        x = (2 * place[..., 0] * columns - 1) / max(columns - 1, 1) - 1
        y = (2 * place[..., 1] * rows - 1) / max(rows - 1, 1) - 1
        reach, unit = boxes[..., 3:].float().mean(-1) / 2, depth_unit(projection, image_size)
        front, back = (
            depth_position((depth + end).clamp(min=MIN_DEPTH), unit.float(), edges)
            for end in (-reach, reach)
        )
        asked = [front - step for step in STEPS] + [back + step for step in STEPS]
        z = 2 * torch.stack(asked, dim=1).clamp(0, edges) / edges - 1  # B, evidence, box
        x, y = (side[:, None].expand_as(z).clamp(-2, 2) for side in (x, y))
        grid = torch.stack([x, y, z], dim=-1)[:, None]  # B, 1, evidence, box, 3
        found = F.grid_sample(nearer, grid, padding_mode="border", align_corners=True)[:, 0, 0]
        classes = surface.class_logits.float().softmax(1)
        kinds = F.grid_sample(
            classes, (2 * place - 1)[:, None], padding_mode="border", align_corners=False
        )[:, :, 0]
        inside = (depth > MIN_DEPTH) & (place > 0).all(-1) & (place < 1).all(-1)
        return torch.cat([found, kinds], dim=1).transpose(1, 2) * inside[..., None]
