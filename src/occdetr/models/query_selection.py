"""Query selection of the two-stage detector on preset ROIs (paper III-B, Fig. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from occdetr.errors import COUNT, InputError, check_range
from occdetr.geometry.rois import RoiLayout
from occdetr.models.layers import BoxHead, class_bias, inverse_sigmoid, take
from occdetr.structures import Memory, Proposals


class QuerySelection(nn.Module):
    """Scores every memory token and turns the best ``num_queries`` into the decoder's queries.

    ``content``: "token" takes a query's content from the selected token (Deformable DETR, early
    matching); "learned" keeps learned contents beside selected anchors (DINO's mixed selection).
    ``position``: "preset" makes the preset ROI of the selected token the query's reference box, as
    the paper says; "refined" lets a box head refine the ROIs first, as two-stage Deformable DETR.

    Raises InputError if there are no classes, or fewer ROIs than queries.
    """

    rois: Tensor

    def __init__(
        self,
        rois: RoiLayout,
        classes: Sequence[int],
        num_queries: int,
        hidden_dim: int,
        content: Literal["token", "learned"] = "token",
        position: Literal["refined", "preset"] = "refined",
    ) -> None:
        super().__init__()
        boxes = torch.from_numpy(rois.boxes())
        check_range("model.detector.selection.num_queries", num_queries, COUNT)
        if num_queries > len(boxes):
            raise InputError(
                f"image_size={list(rois.image_size)}: gives {len(boxes)} tokens, fewer than the "
                f"{num_queries} queries: use a larger image or lower "
                "model.detector.selection.num_queries"
            )
        if not len(classes):
            raise InputError(
                "foreground_classes=[]: the detector has no class to find: give some, or "
                "partition=all_background"
            )
        self.num_queries, self.hidden_dim, self.layout = num_queries, hidden_dim, rois
        self.classes = list(classes)
        self.register_buffer("rois", boxes, persistent=False)
        self.token = nn.Sequential(nn.Linear(hidden_dim, hidden_dim), nn.LayerNorm(hidden_dim))
        self.class_head = nn.Linear(hidden_dim, len(classes))
        refined = position == "refined"
        self.box_head = BoxHead(hidden_dim, hidden_dim, 4, 3) if refined else None
        self.content = nn.Linear(hidden_dim, hidden_dim) if content == "token" else None
        self.learned = nn.Embedding(num_queries, hidden_dim) if content == "learned" else None
        nn.init.constant_(self.class_head.bias, class_bias())

    def forward(
        self, memory: Memory, forced: Bool[Tensor, "batch token"] | None = None
    ) -> tuple[
        Proposals | None,
        Int[Tensor, "batch query"],
        Float[Tensor, "batch query dim"],
        Float[Tensor, "batch query 4"],
    ]:
        """Return the proposals, the selected tokens, query contents and their reference boxes.

        The proposals are for the loss: evaluation has none, and boxes of selected tokens only.
        ``forced`` tokens are selected whatever their score (early matching forces the matched
        ones). The selected tokens are sorted by score.
        """
        tokens = self.token(memory.tokens)
        logits = self.class_head(tokens)
        score = logits.detach().amax(-1)
        first = score if forced is None else score.masked_fill(forced, torch.finfo(score.dtype).max)
        selected = first.topk(self.num_queries, dim=1).indices
        if forced is not None:  # sorted by score too, since learned contents go by rank
            order = score.gather(1, selected).argsort(dim=1, descending=True)
            selected = selected.gather(1, order)
        chosen, proposals = take(tokens, selected), None
        if self.training:
            boxes = self._boxes(tokens, self.rois)
            proposals = Proposals(logits, boxes, self.box_head is not None)
            reference = take(boxes, selected).detach()
        else:
            reference = self._boxes(chosen, self.rois[selected]).detach()
        if self.learned is not None:
            content = self.learned.weight[None].expand(len(memory), -1, -1)
        else:
            assert self.content is not None
            content = self.content(chosen)
        return proposals, selected, content, reference

    def _boxes(
        self, tokens: Float[Tensor, "batch n dim"], rois: Float[Tensor, "*batch n 4"]
    ) -> Float[Tensor, "batch n 4"]:
        """The ROIs of tokens, refined if there is a box head."""
        if self.box_head is None:
            return rois.expand(len(tokens), -1, -1)
        return (inverse_sigmoid(rois) + self.box_head(tokens)).sigmoid()
