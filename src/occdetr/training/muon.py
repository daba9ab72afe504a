"""AdamW with Muon for the matrices: updates whose singular values are all about one.

Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024. torch.optim.Muon
(torch 2.9) takes no kernels and no other parameters beside its matrices; Lightning's automatic
optimization takes one optimizer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

MOMENTUM = 0.95
COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # of the quintic iteration; Jordan et al.
STEPS = 5


class MuonAdamW(torch.optim.AdamW):
    """Groups with ``orthogonal: True`` (matrices, kernels) are updated by Muon, others by AdamW.

    A kernel (out, in, height, width) is a matrix of out rows. ``lr`` of an orthogonal group is the
    spectral norm of a step, times sqrt(rows / columns) where there are more rows; weight decay is
    decoupled.
    """

    def __init__(self, groups: list[dict[str, Any]], **settings: Any) -> None:
        super().__init__([{"orthogonal": False, **group} for group in groups], **settings)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        groups = self.param_groups
        for group in groups:
            if group["orthogonal"]:
                self._step_matrices(group)
        self.param_groups = [group for group in groups if not group["orthogonal"]]
        try:
            super().step()
        finally:
            self.param_groups = groups
        return loss

    def _step_matrices(self, group: dict[str, Any]) -> None:
        """Matrices of one shape are orthogonalised together: one launch on a GPU, not one each."""
        by_shape: dict[torch.Size, list[Tensor]] = {}
        for parameter in group["params"]:
            if parameter.grad is not None:
                by_shape.setdefault(parameter.shape, []).append(parameter)
        for shape, parameters in by_shape.items():
            update = torch.stack([self._momentum(parameter) for parameter in parameters])
            update = orthogonalize(update.flatten(2))
            rows, columns = update.shape[1:]
            rate = -group["lr"] * max(1.0, rows / columns) ** 0.5
            for parameter, change in zip(parameters, update, strict=True):
                parameter.mul_(1 - group["lr"] * group["weight_decay"])
                parameter.add_(change.view(shape).to(parameter.dtype), alpha=rate)

    def _momentum(self, parameter: Tensor) -> Tensor:
        """Nesterov's momentum of the gradients."""
        assert parameter.grad is not None
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)  # AdamW looks for it when a state is loaded
            state["momentum"] = torch.zeros_like(parameter)
        state["step"] += 1
        momentum = state["momentum"].lerp_(parameter.grad, 1 - MOMENTUM)
        return parameter.grad.lerp(momentum, MOMENTUM)


def orthogonalize(matrices: Float[Tensor, "n row column"]) -> Float[Tensor, "n row column"]:
    """About U V' of each matrix U S V', by Newton-Schulz iterations in bf16.

    Singular values end between about 0.7 and 1.2, but for those that were hardly there.
    """
    a, b, c = COEFFICIENTS
    tall = matrices.shape[1] > matrices.shape[2]
    x = (matrices.mT if tall else matrices).bfloat16()
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=1e-7)
    for _ in range(STEPS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if tall else x
