"""AdamW (paper IV-B), or Muon beside it, with rates by part of the network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from torch import nn

from occdetr.errors import (
    BELOW_ONE,
    NOT_NEGATIVE,
    POSITIVE,
    InputError,
    check_each,
    check_ranges,
)
from occdetr.training.muon import MuonAdamW


@dataclass(frozen=True)
class OptimizerSettings:
    """Learning rates and weight decay, by part of the network and kind of parameter.

    Args:
        lr: AdamW's learning rate.
        weight_decay: of what ``decay`` names.
        decay: "matrices" (and kernels), so that biases, norms and embeddings have no weight decay,
            or "all" parameters (the paper, and Deformable DETR).
        betas: AdamW's.
        offset_factor: multiplies the rates of the sampling offsets of deformable attention
            (Deformable DETR: 0.1).
        lr_factors: multiply both rates for parts of the network, by name (backbone: 0.1 with
            pretrained weights, as Deformable DETR).
        matrix_lr: Muon's learning rate, for hidden matrices and kernels; None leaves them to AdamW
            like the rest, as the paper does.
        adamw_parts: parts of the network, by name, whose matrices AdamW updates nevertheless.
        largest_matrix: weights of the largest matrix for Muon; larger ones take too long to
            orthogonalise on a CPU.

    Raises ``InputError`` on values out of range.
    """

    lr: float = 1e-4
    weight_decay: float = 0.01
    betas: Sequence[float] = (0.9, 0.999)
    lr_factors: Mapping[str, float] = field(default_factory=dict)
    matrix_lr: float | None = None
    adamw_parts: Sequence[str] = ()
    largest_matrix: int = 1_000_000
    decay: Literal["matrices", "all"] = "matrices"
    offset_factor: float = 1.0

    def __post_init__(self) -> None:
        check_ranges("optimizer", self, lr=POSITIVE, matrix_lr=POSITIVE)
        names = ("weight_decay", "offset_factor", "largest_matrix")
        check_ranges("optimizer", self, **dict.fromkeys(names, NOT_NEGATIVE))
        check_each("optimizer.lr_factors", dict(self.lr_factors), NOT_NEGATIVE)
        check_each("optimizer.betas", self.betas, BELOW_ONE)
        if len(self.betas) != 2:
            raise InputError(f"optimizer.betas={list(self.betas)}: give two, as in [0.9, 0.999]")


def check_parts(model: nn.Module, settings: OptimizerSettings) -> None:
    """Raises ``InputError`` if ``lr_factors`` or ``adamw_parts`` name what is no part of ``model``.

    A part that the partition leaves out is one still: it is None.
    """
    parts = [name for name, part in model.named_children() if list(part.parameters())]
    parts += [name for name, part in vars(model).items() if part is None and name[0] != "_"]
    for setting, names in (
        ("lr_factors.", settings.lr_factors),
        ("adamw_parts=", settings.adamw_parts),
    ):
        for name in names:
            if name not in parts:
                raise InputError(
                    f"optimizer.{setting}{name}: no such part of the network: choose one of "
                    f"{', '.join(parts)}"
                )


def make_optimizer(model: nn.Module, settings: OptimizerSettings) -> MuonAdamW:
    """The optimizer of all trained parameters of ``model``."""
    groups = parameter_groups(model, settings)
    return MuonAdamW(groups, lr=settings.lr, betas=tuple(settings.betas))


def moved_state(
    model: nn.Module,
    state: dict[str, Any],
    old: OptimizerSettings,
    new: OptimizerSettings,
) -> dict[str, Any]:
    """The ``state_dict`` of an optimizer with ``old`` settings, for one with ``new`` settings.

    Settings decide which parameters form a group, and so their order.

    Raises ``InputError`` if a parameter would change from AdamW to Muon or back.
    """
    kinds, places = {}, {}
    for group in parameter_groups(model, old):
        for parameter in group["params"]:
            places[id(parameter)] = len(places)
            kinds[id(parameter)] = group["orthogonal"]
    groups = parameter_groups(model, new)
    if any(kinds[id(p)] != group["orthogonal"] for group in groups for p in group["params"]):
        raise InputError(
            "optimizer: matrices change between Muon and AdamW: start a run of its own"
        )
    order = [places[id(parameter)] for group in groups for parameter in group["params"]]
    settings = make_optimizer(model, new).state_dict()["param_groups"]
    return {
        "state": {i: state["state"][j] for i, j in enumerate(order) if j in state["state"]},
        "param_groups": [{**group, "initial_lr": group["lr"]} for group in settings],
    }


def parameter_groups(model: nn.Module, settings: OptimizerSettings) -> list[dict[str, Any]]:
    """Trained parameters by learning rate, weight decay and kind of update."""
    groups: dict[tuple[float, float, bool], list[nn.Parameter]] = {}
    matrix_lr = settings.matrix_lr or 0.0
    embeddings = {
        id(p) for m in model.modules() if isinstance(m, nn.Embedding) for p in m.parameters()
    }
    for name, parameter in model.named_parameters():
        if not parameter.requires_grad:
            continue
        matrix = parameter.ndim > 1 and id(parameter) not in embeddings
        hidden = matrix and _is_hidden(name) and parameter.numel() <= settings.largest_matrix
        part = name.split(".")[0]
        orthogonal = hidden and matrix_lr > 0 and part not in settings.adamw_parts
        lr = matrix_lr if orthogonal else settings.lr
        lr *= settings.lr_factors.get(part, 1.0)
        lr *= settings.offset_factor if ".sampling_offsets." in name else 1.0
        decay = settings.weight_decay if matrix or settings.decay == "all" else 0.0
        groups.setdefault((lr, decay, orthogonal), []).append(parameter)
    return [
        {"params": parameters, "lr": lr, "weight_decay": decay, "orthogonal": orthogonal}
        for (lr, decay, orthogonal), parameters in groups.items()
    ]


def _is_hidden(name: str) -> bool:
    """Muon is for what lies between the first layer and the outputs."""
    inner = name.removeprefix("mask_head.")
    first = inner.startswith(("backbone.conv1.", "backbone.stem."))
    return not (first or "head" in inner or "embed" in inner)
