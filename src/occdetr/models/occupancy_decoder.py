"""The mixed dense-sparse 3D occupancy decoder (paper III-C, Fig. 4)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from occdetr.errors import CHANNELS, LAYERS, InputError, check_range
from occdetr.geometry.camera import Camera
from occdetr.geometry.subdivision import (
    all_cells,
    child_boxes,
    child_cells,
    grid_extent,
    project_boxes,
    project_centers,
)
from occdetr.geometry.voxels import GRID_ORIGIN, GRID_SHAPE
from occdetr.models.attention_keys import pooled_keys
from occdetr.models.box_encoding import BoxEncoder
from occdetr.models.decoder_layer import DecoderLayer
from occdetr.models.layers import MLP, AttentionSize, take
from occdetr.models.line_of_sight import LineOfSight
from occdetr.models.occupancy_queries import (
    Background,
    ImageView,
    ObjectQueries,
    Queries,
    key_mask,
)
from occdetr.models.sparse_convolution import SparseConvolution, neighbour_indices
from occdetr.models.splits import Refinement, Split
from occdetr.structures import BackgroundLevel, Memory


@dataclass(frozen=True)
class ObjectCells:
    """The dense half: every object gets a grid of ``cells`` x ``cells`` x ``cells`` over its box.

    The paper's ``cells`` are 2^L, one per child of the last of L layers; with more, each child
    predicts a block of them. ``class_scores`` adds an encoding of the detector's class scores to an
    object's query (the paper does not). ``classes`` are the detector's; empty without a detector.
    """

    classes: Sequence[int]
    cells: int
    class_scores: bool = True


@dataclass(frozen=True)
class BackgroundCells:
    """The sparse half: a ``grid`` (D0, W0, H0) of boxes tiles the space, and the top ``kept[l]`` of
    their children by occupancy (the paper's top-K) remain after layer l.

    ``refine_dim``: the width of a last x 2 split of the kept cells without attention, or None
    (paper). ``grid`` x 2^(layers + refinement) must be the full grid.
    ``key_grid``: queries attend to the mean of each object and of each region of this coarser grid
    (``attention_keys.pooled_keys``), or, None (paper), to all queries.
    ``convolution_dim``: the width of a convolution among neighbouring cells, before each choice
    but the last and after that one (``sparse_convolution``), or None (paper).
    """

    grid: Sequence[int]
    kept: Sequence[int]
    refine_dim: int | None = None
    key_grid: Sequence[int] | None = None
    convolution_dim: int | None = None


class OccupancyDecoder(nn.Module):
    """Dense decoding of the objects' boxes and sparse decoding of a background grid, together.

    Each of ``num_layers`` layers attends, splits every query into 2 x 2 x 2 children, and selects:
    all children of objects, and the background children of the highest occupancy scores.
    ``background`` None: objects only.
    ``sight_dim`` (paper: None) lets every query, and every child but the last layer's, sample that
    many channels of the image at its own centre.

    Raises InputError on values that are out of range or contradict each other.
    """

    cells: Tensor

    def __init__(
        self,
        attention: AttentionSize,
        objects: ObjectCells,
        background: BackgroundCells | None,
        num_layers: int,
        sight_dim: int | None = None,
    ) -> None:
        super().__init__()
        hidden_dim = attention.hidden_dim
        check_range("model.occupancy_decoder.num_layers", num_layers, LAYERS)
        _check_sizes(objects, background, num_layers)
        check_range("model.occupancy_decoder.sight_dim", sight_dim, CHANNELS)
        self.objects, self.background = objects, background
        self.box_encoder = BoxEncoder(hidden_dim)
        self.class_embed = None
        if objects.classes:
            if objects.class_scores:
                self.class_embed = nn.Linear(len(objects.classes), hidden_dim, bias=False)
            inner = objects.cells >> num_layers
            self.foreground_head = MLP(hidden_dim, hidden_dim, inner**3, 2)
        self.layers = nn.ModuleList(DecoderLayer(attention) for _ in range(num_layers))
        self.sight = None
        if sight_dim:
            self.sight = LineOfSight(hidden_dim, attention.num_levels, sight_dim, num_layers)
        self.splits = nn.ModuleList(Split(hidden_dim, hidden_dim) for _ in self.layers)
        if background is not None:
            self.register_buffer("cells", all_cells(tuple(background.grid)), persistent=False)
            self.heads = nn.ModuleList(MLP(hidden_dim, hidden_dim // 2, 1, 2) for _ in self.layers)
            self.final_norm = nn.LayerNorm(hidden_dim)
            self.convolutions = None
            if width := background.convolution_dim:
                mixers = [SparseConvolution(hidden_dim, width) for _ in self.layers]
                self.convolutions = nn.ModuleList(mixers)
            if background.refine_dim:
                self.refinement = Refinement(hidden_dim, background.refine_dim)

    @property
    def cell_sizes(self) -> list[int]:
        """Edges of the background cells of every level, in voxels, the finest last."""
        if self.background is None:
            return []
        coarsest = GRID_SHAPE[0] // self.background.grid[0]
        splits = len(self.layers) + (1 if self.background.refine_dim else 0)
        return [coarsest >> (index + 1) for index in range(splits)]

    def forward(
        self, objects: ObjectQueries, memory: Memory, camera: Camera
    ) -> tuple[Float[Tensor, "batch slot n n n"] | None, Background | None]:
        """Decode the objects (there may be none) and the background (it may be absent).

        Returns the logits of the objects' cells, in spatial order, and the background.
        """
        view = ImageView(memory, camera, None if self.sight is None else self.sight.maps(memory))
        queries, position = self._initial_queries(objects, view)
        levels: list[BackgroundLevel] = []
        kept = sparse = None
        for index in range(len(self.layers)):
            queries = self._attend(index, queries, position, objects.used, view)
            queries = self._split(index, queries, view)
            if self.background is not None:
                candidates, kept, sparse = self._select(index, self.background, queries)
                levels.append(candidates)
            if index + 1 < len(self.layers):
                queries, position = self._next_queries(index + 1, queries, kept, sparse)
        slots, dense = objects.boxes3d.shape[1], queries.num_dense
        logits = self._foreground_grid(queries.features[:, :dense], slots) if slots else None
        del queries  # the largest tensor of all
        if kept is None or sparse is None:
            return logits, None
        sparse = self._convolve(len(self.layers) - 1, sparse, kept.coordinates)
        position = self.box_encoder.of_cells(kept.coordinates, self._grid(len(self.layers)))
        features = self.final_norm(sparse + position)
        return logits, self._finest(features, kept, levels)

    # ------------------------------------------------------------------ the steps of forward

    def _initial_queries(self, objects: ObjectQueries, view: ImageView) -> tuple[Queries, Tensor]:
        """The objects' features and the encoding of all boxes, summed; and the encoding."""
        cells = self._initial_cells(len(objects.boxes3d))
        boxes = torch.cat([objects.boxes3d, self._cell_boxes(cells, level=0)], dim=1)
        position = self._encode(boxes, cells, level=0)
        features = self._look(position, boxes, view, kind=0)
        if slots := objects.boxes3d.shape[1]:
            content = objects.query_feat
            if self.class_embed is not None:
                content = content + self.class_embed(objects.class_scores)
            features = features + F.pad(content, (0, 0, 0, boxes.shape[1] - slots))
        return Queries(features, boxes, cells), position

    def _attend(
        self,
        index: int,
        queries: Queries,
        position: Float[Tensor, "batch query dim"],
        used: Bool[Tensor, "batch slot"],
        view: ImageView,
    ) -> Queries:
        """Self-attention, cross-attention at the boxes' projections, feed-forward."""
        if self.background is None or self.background.key_grid is None:
            keys, mask = None, key_mask(used, queries.num_dense, queries.boxes.shape[1])
        else:
            key_grid = self.background.key_grid
            keys, mask = pooled_keys(queries, used, self._grid(index), key_grid)
        reference = project_boxes(queries.boxes, view.camera)
        features = self.layers[index](
            queries.features, position, reference, view.memory, keys, mask
        )
        return dataclasses.replace(queries, features=features)

    def _split(self, index: int, queries: Queries, view: ImageView) -> Queries:
        """The 8 children of every query."""
        features = self.splits[index](queries.features)
        dense_boxes = child_boxes(queries.boxes[:, : queries.num_dense])
        cells = child_cells(queries.cells)
        boxes = torch.cat([dense_boxes, self._cell_boxes(cells, index + 1)], dim=1)
        if index + 1 < len(self.layers):
            features = self._look(features, boxes, view, kind=index + 1)
        return Queries(features, boxes, cells)

    def _select(
        self, index: int, background: BackgroundCells, queries: Queries
    ) -> tuple[BackgroundLevel, BackgroundLevel, Float[Tensor, "batch kept dim"]]:
        """The top-K: the background's candidates, those kept, and the features of these."""
        sparse = queries.features[:, queries.num_dense :]
        if index + 1 < len(self.layers):
            sparse = self._convolve(index, sparse, queries.cells)
        logits = self.heads[index](sparse).squeeze(-1)
        best = logits.detach().topk(background.kept[index], dim=1).indices
        cells, cell = take(queries.cells, best), self.cell_sizes[index]
        candidates = BackgroundLevel(queries.cells, logits, cell)
        kept = BackgroundLevel(cells, logits.gather(1, best), cell)
        return candidates, kept, take(sparse, best)

    def _convolve(
        self,
        index: int,
        sparse: Float[Tensor, "batch cell dim"],
        cells: Int[Tensor, "batch cell 3"],
    ) -> Float[Tensor, "batch cell dim"]:
        """The features of the background's cells after layer ``index``, with their neighbours'."""
        if self.convolutions is None:
            return sparse
        return self.convolutions[index](sparse, neighbour_indices(cells, self._grid(index + 1)))

    def _next_queries(
        self,
        level: int,
        queries: Queries,
        kept: BackgroundLevel | None,
        sparse: Float[Tensor, "batch kept dim"] | None,
    ) -> tuple[Queries, Tensor]:
        """All children of objects, the background's that are kept, each with the encoding of its
        box added; and the encoding."""
        dense = queries.num_dense
        features, boxes, cells = queries.features, queries.boxes, queries.cells
        if kept is not None and sparse is not None:
            cells = kept.coordinates
            features = torch.cat([features[:, :dense], sparse], dim=1)
            boxes = torch.cat([boxes[:, :dense], self._cell_boxes(cells, level)], dim=1)
        position = self._encode(boxes, cells, level)
        return Queries(features + position, boxes, cells), position

    def _finest(
        self, features: Tensor, kept: BackgroundLevel, levels: list[BackgroundLevel]
    ) -> Background:
        """The voxels at full resolution: the kept cells themselves, or their refinement."""
        if self.background is None or self.background.refine_dim is None:
            return Background(levels, kept, features, features)
        embedding, logits = self.refinement(features)
        finest = BackgroundLevel(child_cells(kept.coordinates), logits, 1)
        return Background([*levels, finest], finest, features, embedding)

    # ------------------------------------------------------------------ boxes and cells

    def _look(self, x: Tensor, boxes: Tensor, view: ImageView, kind: int) -> Tensor:
        """Add the image's features at the centres of the boxes."""
        if self.sight is None or view.maps is None:
            return x
        return x + self.sight(view.maps, project_centers(boxes, view.camera), kind)

    def _encode(
        self, boxes: Float[Tensor, "batch box 6"], cells: Int[Tensor, "batch cell 3"], level: int
    ) -> Float[Tensor, "batch box dim"]:
        """The encoding of the objects' boxes, then of the background's cells, which come last."""
        dense = boxes.shape[1] - cells.shape[1]
        encoded = [self.box_encoder(boxes[:, :dense])]
        if self.background is not None:
            encoded.append(self.box_encoder.of_cells(cells, self._grid(level)))
        return torch.cat(encoded, dim=1)

    def _grid(self, level: int) -> tuple[int, int, int]:
        """The number of background cells of a level along each axis."""
        x, y, z = GRID_SHAPE if self.background is None else self.background.grid
        return x << level, y << level, z << level

    def _initial_cells(self, batch: int) -> Int[Tensor, "batch cell 3"]:
        if self.background is None:
            device = self.box_encoder.norm.weight.device
            return torch.zeros(batch, 0, 3, dtype=torch.long, device=device)
        return self.cells[None].expand(batch, -1, -1)

    def _cell_boxes(
        self, cells: Int[Tensor, "batch cell 3"], level: int
    ) -> Float[Tensor, "batch cell 6"]:
        """Boxes (centre, size) in metres of the background cells of a level."""
        place = cells.to(self.box_encoder.norm.weight.dtype) + 0.5
        sizes = [
            length / side for length, side in zip(grid_extent(), self._grid(level), strict=True)
        ]
        center = [origin + place[..., i] * sizes[i] for i, origin in enumerate(GRID_ORIGIN)]
        size = [torch.full_like(place[..., i], sizes[i]) for i in range(3)]
        return torch.stack([*center, *size], dim=-1)

    def _foreground_grid(self, x: Tensor, slots: int) -> Float[Tensor, "batch slot n n n"]:
        """Logits of the objects' cells. The head gives one block of cells per child, z fastest;
        here blocks and cells are put into spatial order."""
        logits = self.foreground_head(x)  # B, slots * 8^L, inner^3
        layers, side = len(self.layers), self.objects.cells
        inner = side >> layers
        logits = logits.reshape(logits.shape[0] * slots, *[2] * (3 * layers), *[inner] * 3)
        order = [1 + axis + 3 * split for axis in range(3) for split in range(layers + 1)]
        return logits.permute(0, *order).reshape(-1, slots, side, side, side)


def _check_sizes(objects: ObjectCells, background: BackgroundCells | None, num_layers: int) -> None:
    """Raise InputError if the cells do not add up."""
    if objects.cells % 2**num_layers or not 1 <= objects.cells <= max(GRID_SHAPE):
        raise InputError(
            f"model.occupancy_decoder.objects.cells={objects.cells}: must be a multiple of "
            f"{2**num_layers} up to {max(GRID_SHAPE)}: each layer splits an object's cells in two"
        )
    if background is None:
        return
    if len(background.kept) != num_layers:
        raise InputError(
            f"model.occupancy_decoder.background.kept={list(background.kept)}: give one number "
            f"for each of the num_layers={num_layers} layers"
        )
    for name in ("refine_dim", "convolution_dim"):
        check_range(
            f"model.occupancy_decoder.background.{name}", getattr(background, name), CHANNELS
        )
    factor = 2 ** (num_layers + (1 if background.refine_dim else 0))
    if tuple(side * factor for side in background.grid) != GRID_SHAPE:
        raise InputError(
            f"model.occupancy_decoder.background.grid={list(background.grid)}: times {factor} must "
            f"give {list(GRID_SHAPE)}; change it, or the number of layers"
        )
    candidates = math.prod(background.grid)
    for kept in background.kept:
        candidates *= 8
        if not 1 <= kept <= candidates:
            raise InputError(
                f"model.occupancy_decoder.background.kept={list(background.kept)}: {kept} of "
                f"{candidates} candidates: a layer keeps 1 to all of the children of those that "
                "the one before keeps"
            )
        candidates = kept
    _check_key_grid(background)


def _check_key_grid(background: BackgroundCells) -> None:
    """Raise InputError if the regions do not consist of whole cells of the coarsest grid."""
    if background.key_grid is None:
        return
    keys, grid = list(background.key_grid), list(background.grid)
    if len(keys) != 3 or any(
        not 1 <= key <= side or side % key for key, side in zip(keys, grid, strict=True)
    ):
        raise InputError(
            f"model.occupancy_decoder.background.key_grid={keys}: give three numbers that divide "
            f"those of grid={grid}, or null"
        )
