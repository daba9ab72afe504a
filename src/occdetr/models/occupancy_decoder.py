"""The mixed dense-sparse 3D occupancy decoder (paper III-C, Fig. 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from occdetr.errors import InputError
from occdetr.geometry.subdivision import (
    all_cells,
    child_boxes,
    child_cells,
    grid_extent,
    project_boxes,
    project_centers,
)
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE
from occdetr.models.decoder_layer import DecoderLayer
from occdetr.models.deformable_attention import Shapes
from occdetr.models.layers import MLP, FeedForward, sine_encoding, take
from occdetr.models.line_of_sight import LineOfSight
from occdetr.structures import BackgroundLevel

NUM_FREQUENCIES = 12  # per coordinate of a box
MAX_FREQUENCY = 96.0  # periods over the grid's extent: cells of 0.4 m are told apart


@dataclass
class Background:
    """What the sparse half of the decoder gives.

    ``levels``: the candidates of every level, which the occupancy loss supervises. ``finest``: the
    voxels of the full grid. ``features``: one per kept voxel, for the mask head to attend to.
    ``embedding``: one per finest voxel, for the mask head to classify.
    """

    levels: list[BackgroundLevel]
    finest: BackgroundLevel
    features: Float[Tensor, "batch kept dim"]
    embedding: Float[Tensor, "batch voxel voxel_dim"]


class Split(nn.Module):
    """x 2 upsampling: every query becomes the 2 x 2 x 2 children of its box.

    Children are ordered x, y, z with z fastest: child 4 x + 2 y + z of query q stands at 8 q + it.
    """

    def __init__(self, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(hidden_dim, 8 * out_dim)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Float[Tensor, "batch query dim"]) -> Float[Tensor, "batch child out"]:
        children = self.linear(x).unflatten(-1, (8, -1)).flatten(1, 2)
        return self.norm(children)


class OccupancyDecoder(nn.Module):
    """Dense decoding of N foreground boxes, sparse decoding of a background grid, together.

    ``background_grid`` (D0, W0, H0) tiles the space; after layer l, ``kept[l]`` background children
    remain. ``refine_dim``: None, or the width of a last x 2 split of the kept voxels without
    attention. ``background_grid`` x 2^(layers + refinement) must be the full grid. With
    ``sight_dim`` (beyond the paper) every query, and every child but those of the last layer, sees
    that many channels of the image at its own centre, not just what its parent has sampled.
    """

    cells: Tensor

    def __init__(
        self,
        hidden_dim: int,
        num_heads: int,
        num_levels: int,
        num_points: int,
        feedforward_dim: int,
        num_foreground_classes: int,
        background_grid: Sequence[int] | None,
        kept: Sequence[int],
        key_strides: Sequence[int],
        refine_dim: int | None,
        object_cells: int,
        sight_dim: int | None = None,  # checkpoints from before it have none
    ) -> None:
        super().__init__()
        self.background_grid = None if background_grid is None else tuple(background_grid)
        self.kept = tuple(kept)
        self._check(refine_dim)
        self.refine_dim = refine_dim
        self.object_cells = object_cells
        inner = object_cells >> len(key_strides)
        if inner << len(key_strides) != object_cells:
            raise InputError(
                f"model.occupancy_decoder.object_cells={object_cells}: must be a multiple of "
                f"{2 ** len(key_strides)}, as each layer splits an object's cells in two"
            )
        self.box_encoder = MLP(6 * 2 * NUM_FREQUENCIES, hidden_dim, hidden_dim, 2)
        self.box_norm = nn.LayerNorm(hidden_dim)  # as loud as the content that it is added to
        if num_foreground_classes:
            self.class_embed = nn.Linear(num_foreground_classes, hidden_dim, bias=False)
            self.foreground_head = MLP(hidden_dim, hidden_dim, inner**3, 2)
        self.layers = nn.ModuleList(
            DecoderLayer(hidden_dim, num_heads, num_levels, num_points, feedforward_dim, stride)
            for stride in key_strides
        )
        self.sight = None
        if sight_dim:
            self.sight = LineOfSight(hidden_dim, num_levels, sight_dim, len(self.layers))
        self.splits = nn.ModuleList(Split(hidden_dim, hidden_dim) for _ in self.layers)
        if self.background_grid is not None:
            self.register_buffer("cells", all_cells(self.background_grid), persistent=False)
            self.heads = nn.ModuleList(MLP(hidden_dim, hidden_dim // 2, 1, 2) for _ in self.layers)
            self.final_norm = nn.LayerNorm(hidden_dim)
            if refine_dim:
                self.refine_feed_forward = FeedForward(hidden_dim, feedforward_dim)
                self.refine_split = Split(hidden_dim, refine_dim)
                self.refine_head = MLP(refine_dim, refine_dim, 1, 2)

    def _check(self, refine_dim: int | None) -> None:
        if self.background_grid is None:
            return
        factor = 2 ** (len(self.kept) + (1 if refine_dim else 0))
        if tuple(side * factor for side in self.background_grid) != GRID_SHAPE:
            raise InputError(
                f"model.occupancy_decoder.background_grid={list(self.background_grid)}: times "
                f"{factor} must give {list(GRID_SHAPE)}; change it, or the number of layers"
            )

    def forward(
        self,
        foreground: Float[Tensor, "batch slot dim"],
        boxes3d: Float[Tensor, "batch slot 6"],
        class_scores: Float[Tensor, "batch slot class"],
        slot_mask: Bool[Tensor, "batch slot"],
        memory: Float[Tensor, "batch token dim"],
        shapes: Shapes,
        projection: Float[Tensor, "batch 3 4"],
        lidar_to_camera: Float[Tensor, "batch 4 4"],
        image_size: tuple[int, int],
    ) -> tuple[Tensor | None, Background | None]:
        """Decode; ``slot`` may be 0, and the background may be absent.

        Returns the foreground logits (batch, slot, n, n, n) and the background.
        """
        batch, slots = foreground.shape[:2]
        dense_boxes, coordinates = boxes3d, self._background_cells(batch)
        boxes = torch.cat([dense_boxes, self._cell_boxes(coordinates, level=0)], dim=1)
        camera = projection, lidar_to_camera, image_size
        maps = None if self.sight is None else self.sight.maps(memory, shapes)
        position = self.encode_boxes(boxes)
        x = self._look(position, maps, boxes, camera, kind=0)
        if slots:
            content = foreground + self.class_embed(class_scores)
            x = x + F.pad(content, (0, 0, 0, boxes.shape[1] - slots))
        levels: list[BackgroundLevel] = []
        dense = slots
        for index, (layer, split) in enumerate(zip(self.layers, self.splits, strict=True)):
            mask = self._key_mask(slot_mask, dense, boxes.shape[1])
            reference = project_boxes(boxes, *camera)
            x = split(layer(x, position, reference, memory, shapes, mask))
            dense *= 8
            dense_boxes, coordinates = child_boxes(dense_boxes), child_cells(coordinates)
            if index + 1 < len(self.layers):
                children = torch.cat([dense_boxes, self._cell_boxes(coordinates, index + 1)], dim=1)
                x = self._look(x, maps, children, camera, kind=index + 1)
            x_dense, x_sparse = x[:, :dense], x[:, dense:]
            if self.background_grid is not None:
                level = self._level(index, coordinates, x_sparse)
                levels.append(level)
                best = level.logits.detach().topk(self.kept[index], dim=1).indices
                coordinates = take(coordinates, best)
                x_sparse = take(x_sparse, best)
            boxes = torch.cat([dense_boxes, self._cell_boxes(coordinates, index + 1)], dim=1)
            if index + 1 < len(self.layers):
                position = self.encode_boxes(boxes)
                x = torch.cat([x_dense, x_sparse], dim=1) + position
        foreground_logits = self._foreground_grid(x_dense, slots) if slots else None
        if self.background_grid is None:
            return foreground_logits, None
        features = self.final_norm(x_sparse + self.encode_boxes(boxes[:, dense:]))
        kept = BackgroundLevel(coordinates, levels[-1].logits.gather(1, best), levels[-1].cell)
        return foreground_logits, self._finest(features, kept, levels)

    def _look(
        self, x: Tensor, maps: list[Tensor] | None, boxes: Tensor, camera: tuple, kind: int
    ) -> Tensor:
        """Add what the image shows at the centres of the boxes."""
        if self.sight is None or maps is None:
            return x
        return x + self.sight(maps, project_centers(boxes, *camera), kind)

    @property
    def cell_sizes(self) -> list[int]:
        """Edges of the background cells of every level, in voxels, the finest last."""
        if self.background_grid is None:
            return []
        coarsest = GRID_SHAPE[0] // self.background_grid[0]
        splits = len(self.layers) + (1 if self.refine_dim else 0)
        return [coarsest >> (index + 1) for index in range(splits)]

    def _level(self, index: int, coordinates: Tensor, features: Tensor) -> BackgroundLevel:
        """The candidates of a level with their occupancy scores."""
        logits = self.heads[index](features).squeeze(-1)
        return BackgroundLevel(coordinates, logits, self.cell_sizes[index])

    def _finest(
        self, features: Tensor, kept: BackgroundLevel, levels: list[BackgroundLevel]
    ) -> Background:
        """The full-resolution voxels: the kept ones themselves, or their refinement."""
        if self.refine_dim is None:
            return Background(levels, kept, features, features)
        embedding = self.refine_split(self.refine_feed_forward(features))
        logits = self.refine_head(embedding).squeeze(-1)
        finest = BackgroundLevel(child_cells(kept.coordinates), logits, 1)
        return Background([*levels, finest], finest, features, embedding)

    def encode_boxes(self, boxes: Float[Tensor, "batch box 6"]) -> Float[Tensor, "batch box dim"]:
        """The query of a box: sines of its place in the grid and its log size, through an MLP."""
        origin, extent = boxes.new_tensor(GRID_ORIGIN), boxes.new_tensor(grid_extent())
        place = (boxes[..., :3] - origin) / extent
        size = (boxes[..., 3:].clamp(min=1e-3).log2() + 4.0) / 8.0  # 6 cm to 16 m -> 0 to 1
        values = torch.cat([place, size], dim=-1)
        encoded = self.box_encoder(sine_encoding(values, NUM_FREQUENCIES, MAX_FREQUENCY))
        return self.box_norm(encoded)

    def _background_cells(self, batch: int) -> Int[Tensor, "batch cell 3"]:
        if self.background_grid is None:
            device = self.box_norm.weight.device
            return torch.zeros(batch, 0, 3, dtype=torch.long, device=device)
        return self.cells[None].expand(batch, -1, -1)

    def _cell_boxes(self, cells: Int[Tensor, "batch cell 3"], level: int) -> Tensor:
        """Boxes (centre, size) in metres of the background cells of a level."""
        like = self.box_norm.weight
        grid = self.background_grid or GRID_SHAPE
        shape = like.new_tensor([float(side * 2**level) for side in grid])
        size = like.new_tensor(grid_extent()) / shape
        center = like.new_tensor(GRID_ORIGIN) + (cells.to(like.dtype) + 0.5) * size
        return torch.cat([center, size.expand_as(center)], dim=-1)

    @staticmethod
    def _key_mask(slot_mask: Tensor, dense: int, total: int) -> Tensor:
        """Keys that may be seen: the children of used slots and all of the background.

        If there is no background the first key stays visible, so that attention is always defined.
        """
        batch, slots = slot_mask.shape
        used = slot_mask.repeat_interleave(dense // slots, dim=1) if slots else slot_mask
        rest = torch.ones(batch, total - dense, dtype=torch.bool, device=slot_mask.device)
        first = torch.arange(total, device=slot_mask.device) == 0
        mask = torch.cat([used, rest], dim=1)
        return mask | (first & (dense == total))

    def _foreground_grid(self, x: Tensor, slots: int) -> Float[Tensor, "batch slot n n n"]:
        """Logits of all cells, put in spatial order: those of a child lie together, z fastest."""
        logits = self.foreground_head(x)  # B, slots * 8^L, inner^3
        layers, inner = len(self.layers), self.object_cells >> len(self.layers)
        logits = logits.reshape(logits.shape[0] * slots, *[2] * (3 * layers), *[inner] * 3)
        order = [1 + axis + 3 * split for axis in range(3) for split in range(layers + 1)]
        side = self.object_cells
        return logits.permute(0, *order).reshape(-1, slots, side, side, side)
