"""AdamW with a linear schedule to zero (paper IV-B), after a short warm-up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn


@dataclass(frozen=True)
class OptimizerSettings:
    """``lr`` falls linearly to zero over the run, after ``warmup_steps`` of linear rise.

    ``lr_factors`` scale it for parts of the model, by the name of the part (backbone 0.1 with
    pretrained weights, as Deformable DETR). Weight decay is for matrices and kernels, not for
    biases, norms and embeddings.
    """

    lr: float = 1e-4
    weight_decay: float = 0.01
    warmup_steps: int = 0
    lr_factors: Mapping[str, float] = field(default_factory=dict)


def configure(model: nn.Module, settings: OptimizerSettings, total_steps: int) -> dict[str, Any]:
    """What ``LightningModule.configure_optimizers`` returns."""
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    embeddings = {
        id(p) for m in model.modules() if isinstance(m, nn.Embedding) for p in m.parameters()
    }
    for name, parameter in model.named_parameters():
        if not parameter.requires_grad:
            continue
        lr = settings.lr * settings.lr_factors.get(name.split(".")[0], 1.0)
        matrix = parameter.ndim > 1 and id(parameter) not in embeddings
        decay = settings.weight_decay if matrix else 0.0
        groups.setdefault((lr, decay), []).append(parameter)
    optimizer = torch.optim.AdamW(
        [{"params": p, "lr": lr, "weight_decay": decay} for (lr, decay), p in groups.items()]
    )

    def factor(step: int) -> float:
        rise = (step + 1) / (settings.warmup_steps + 1)
        fall = (total_steps - step) / max(total_steps - settings.warmup_steps, 1)
        return max(min(rise, fall, 1.0), 0.0)

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
