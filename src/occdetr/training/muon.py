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
    decoupled. AdamW's update of a parameter is one kernel.
    """

    def __init__(self, groups: list[dict[str, Any]], **settings: Any) -> None:
        super().__init__([_with_kernel(group) for group in groups], **settings)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Also of older versions, which computed AdamW's update in several kernels."""
        groups = [_with_kernel(group) for group in state_dict["param_groups"]]
        super().load_state_dict({**state_dict, "param_groups": groups})

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
            update = parameters[0].new_empty((len(parameters), *shape))
            for parameter, into in zip(parameters, update, strict=True):
                self._momentum(parameter, into)
            change = orthogonalize(update.flatten(2)).view_as(update)
            rows, columns = update.flatten(2).shape[1:]
            rate = -group["lr"] * max(1.0, rows / columns) ** 0.5
            lists: Any = torch  # its functions of lists have no public names
            lists._foreach_mul_(parameters, 1 - group["lr"] * group["weight_decay"])
            lists._foreach_add_(parameters, change.unbind(), alpha=rate)

    def _momentum(self, parameter: Tensor, into: Tensor) -> None:
        """Nesterov's momentum of the gradients."""
        assert parameter.grad is not None
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)  # AdamW looks for it when a state is loaded
            state["momentum"] = torch.zeros_like(parameter)
        state["step"] += 1
        momentum = state["momentum"].lerp_(parameter.grad, 1 - MOMENTUM)
        torch.lerp(parameter.grad, momentum, MOMENTUM, out=into)


def _with_kernel(group: dict[str, Any]) -> dict[str, Any]:
    orthogonal = group.get("orthogonal", False)
    return {**group, "orthogonal": orthogonal, "fused": not orthogonal}


def orthogonalize(matrices: Float[Tensor, "n row column"]) -> Float[Tensor, "n row column"]:
    """About U V' of each matrix U S V', by Newton-Schulz iterations: an odd polynomial of the
    matrix, five times.

    Singular values end between about 0.7 and 1.2, but for those that were hardly there. On a CPU it
    computes in float32 with the fewest operations, on a GPU in bf16, for which small singular
    values need the plain iteration.
    """
    tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.mT if tall else matrices
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=1e-7)
    rows, columns = x.shape[1:]
    if not x.is_cpu:
        x = iterate(x.bfloat16()).to(matrices.dtype)
    elif 2 * columns > 3 * rows:  # 8 r + 68 instead of 40 r + 20 multiply-adds / rows^3
        x = iterate_gram(x)
    else:
        x = iterate(x)
    return x.mT.contiguous() if tall else x


def iterate(x: Float[Tensor, "n row column"]) -> Float[Tensor, "n row column"]:
    """a X + b (X X') X + c (X X')^2 X, ``STEPS`` times."""
    a, b, c = COEFFICIENTS
    for _ in range(STEPS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x


def iterate_gram(x: Float[Tensor, "n row column"]) -> Float[Tensor, "n row column"]:
    """The same through the small matrices G = X X' alone.

    Each step multiplies X by P = a + b G + c G^2, and so G by P^2; all of them commute. Singular
    values below about 1e-3 of the largest take part with an error, that of G in float32.
    """
    a, b, c = COEFFICIENTS
    gram = x @ x.mT
    product = None
    for step in range(STEPS):
        factor = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)
        factor.diagonal(dim1=1, dim2=2).add_(a)
        product = factor if product is None else factor @ product
        if step < STEPS - 1:
            gram = factor @ (factor @ gram)
    assert product is not None
    return product @ x
