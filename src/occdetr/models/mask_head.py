"""MaskFormer over the sparse background voxels (paper III-A; Cheng et al., MaskFormer, 2021)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from occdetr.errors import CHANNELS, LAYERS, InputError, check_range
from occdetr.models.layers import (
    MLP,
    Attention,
    AttentionSize,
    FeedForward,
    FewQueryAttention,
    class_bias,
)


class MaskLayer(nn.Module):
    """Semantic queries attend to the voxel features, then to each other, then feed forward."""

    def __init__(self, size: AttentionSize) -> None:
        super().__init__()
        self.cross_attention = FewQueryAttention(size.hidden_dim, size.num_heads)
        self.cross_norm = nn.LayerNorm(size.hidden_dim)
        self.self_attention = Attention(size.hidden_dim, size.num_heads)
        self.self_norm = nn.LayerNorm(size.hidden_dim)
        self.feed_forward = FeedForward(size.hidden_dim, size.feedforward_dim)

    def forward(self, query: Tensor, position: Tensor, features: Tensor) -> Tensor:
        attended = self.cross_attention(query + position, features)
        query = self.cross_norm(query + attended)
        placed = query + position
        query = self.self_norm(query + self.self_attention(placed, placed, query))
        return self.feed_forward(query)


class MaskHead(nn.Module):
    """One semantic query per class; a logit is its mask embedding times the voxel's embedding.

    The mask embedding has one more element, the bias of its class. Products are not divided by the
    square root of the width: both factors come out of small MLPs, so that logits start small.
    ``embed_voxels``: the voxels' embedding first goes through an MLP (paper).
    ``auxiliary``: give the logits after every layer in training, as MaskFormer supervises them.
    Raises InputError on values out of range.
    """

    def __init__(
        self,
        classes: Sequence[int],
        attention: AttentionSize,
        num_layers: int,
        voxel_dim: int,
        embed_voxels: bool = True,
        auxiliary: bool = False,
    ) -> None:
        super().__init__()
        check_range("model.mask_head.num_layers", num_layers, LAYERS)
        check_range("model.mask_head.voxel_dim", voxel_dim, CHANNELS)
        if not len(classes):
            raise InputError(
                "mask_classes=[]: the mask head has no class to predict: give some, or "
                "partition=all_foreground"
            )
        self.classes, self.voxel_dim = list(classes), voxel_dim
        self.auxiliary = auxiliary
        hidden_dim = attention.hidden_dim
        self.query_feat = nn.Embedding(len(classes), hidden_dim)
        self.query_pos = nn.Embedding(len(classes), hidden_dim)
        self.layers = nn.ModuleList(MaskLayer(attention) for _ in range(num_layers))
        self.mask_embed = MLP(hidden_dim, hidden_dim, voxel_dim + 1, 3)
        self.voxel_embed = MLP(voxel_dim, voxel_dim, voxel_dim, 2) if embed_voxels else None
        last = self.mask_embed[-1]
        assert isinstance(last, nn.Linear)
        nn.init.constant_(last.bias[-1:], class_bias(0.05))

    def forward(
        self,
        features: Float[Tensor, "batch kept dim"],
        embedding: Float[Tensor, "batch voxel voxel_dim"],
    ) -> list[Float[Tensor, "batch class voxel"]]:
        """Logits of every class and voxel, the final ones last; ``features`` are what the queries
        attend to."""
        if self.voxel_embed is not None:
            embedding = self.voxel_embed(embedding)
        embedding = embedding.transpose(1, 2)
        query = self.query_feat.weight[None].expand(len(features), -1, -1)
        position = self.query_pos.weight[None]
        logits = []
        for index, layer in enumerate(self.layers):
            query = layer(query, position, features)
            if index + 1 == len(self.layers) or (self.auxiliary and self.training):
                mask = self.mask_embed(query)
                logits.append(torch.baddbmm(mask[..., -1:], mask[..., :-1], embedding))
        return logits
