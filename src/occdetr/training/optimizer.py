"""AdamW, or Muon beside it, with a linear schedule to zero (paper IV-B) after a short warm-up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from occdetr.training.muon import MuonAdamW


@dataclass(frozen=True)
class OptimizerSettings:
    """``lr`` falls linearly to zero over the run, after ``warmup_steps`` of linear rise.

    ``lr_factors`` scale it for parts of the model, by the name of the part (backbone 0.1 with
    pretrained weights, as Deformable DETR). Weight decay is for matrices and kernels, not for
    biases, norms and embeddings. ``matrix_lr``: the rate at which Muon moves hidden matrices and
    kernels of up to ``largest_matrix`` weights (larger ones take too long to orthogonalise on a
    CPU); None leaves them to AdamW like the rest, as the paper does.
    """

    lr: float = 1e-4
    weight_decay: float = 0.01
    betas: Sequence[float] = (0.9, 0.999)
    warmup_steps: int = 0
    lr_factors: Mapping[str, float] = field(default_factory=dict)
    matrix_lr: float | None = None
    largest_matrix: int = 1_000_000


def configure(model: nn.Module, settings: OptimizerSettings, total_steps: int) -> dict[str, Any]:
    """What ``LightningModule.configure_optimizers`` returns."""
    groups = parameter_groups(model, settings)
    optimizer = MuonAdamW(groups, lr=settings.lr, betas=tuple(settings.betas))

    def factor(step: int) -> float:
        rise = (step + 1) / (settings.warmup_steps + 1)
        fall = (total_steps - step) / max(total_steps - settings.warmup_steps, 1)
        return max(min(rise, fall, 1.0), 0.0)

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


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
        orthogonal = hidden and matrix_lr > 0
        lr = matrix_lr if orthogonal else settings.lr
        lr *= settings.lr_factors.get(name.split(".")[0], 1.0)
        decay = settings.weight_decay if matrix else 0.0
        groups.setdefault((lr, decay, orthogonal), []).append(parameter)
    return [
        {"params": parameters, "lr": lr, "weight_decay": decay, "orthogonal": orthogonal}
        for (lr, decay, orthogonal), parameters in groups.items()
    ]


def _is_hidden(name: str) -> bool:
    """Muon is for what lies between the first layer and the outputs."""
    inner = name.removeprefix("mask_head.")
    return not (inner.startswith("backbone.conv1.") or "head" in inner or "embed" in inner)
