"""The groups by which the terms of the loss are logged."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from occdetr.losses.detection import TERMS

#: Group by the beginning of a term's name; detection's terms of the last layer have no prefix.
_GROUPS = {
    "aux_": "auxiliary",
    "proposal_": "proposal",
    "foreground_": "occupancy",
    "background_": "occupancy",
    "mask_": "mask",
    "scene_": "mask",
    "sem_": "mask",
    "geo_": "occupancy",
}


def loss_group(term: str) -> str:
    """``detection``, ``auxiliary``, ``proposal``, ``occupancy``, ``mask``, or ``other``.

    ``other`` are terms of criteria that are not this package's.

    Example:
        >>> from occdetr.losses.groups import loss_group
        >>> loss_group("cls"), loss_group("aux_cls"), loss_group("mask_dice")
        ('detection', 'auxiliary', 'mask')
    """
    if term in TERMS:
        return "detection"
    return next((group for prefix, group in _GROUPS.items() if term.startswith(prefix)), "other")


def grouped_losses(terms: Iterable[str], values: Float[Tensor, " term"]) -> dict[str, Tensor]:
    """The values of ``terms`` and the sums of their groups, by the names to log them under."""
    figures: dict[str, Tensor] = {}
    groups: dict[str, list[Tensor]] = {}
    for term, value in zip(terms, values.unbind(), strict=True):
        group = loss_group(term)
        figures[f"loss_{group}/{term}"] = value
        groups.setdefault(group, []).append(value)
    return figures | {f"loss/{name}": torch.stack(own).sum() for name, own in groups.items()}
