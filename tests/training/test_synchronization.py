"""Predictions do not wait for the device, and a training step's losses wait once.

Shown on the device "meta", whose tensors have no values: whatever the host reads raises, as does
what has a size that depends on values. What is copied from the host is found at the call. On a GPU
the same is shown by ``tests/test_cuda.py``.
"""

from __future__ import annotations

import contextlib
import functools
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from model_factory import small_batch, tiny_model, tiny_stage
from occdetr.losses import matcher
from occdetr.training import pretrain

META = torch.device("meta")
WITHOUT_FILE = "model.backbone.weights=null"


class OneDevice(TorchDispatchMode):
    """Raises at an operator whose tensors are on two devices."""

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        result = function(*args, **(kwargs or {}))
        leaves = tree_leaves((args, kwargs, result))
        devices = {leaf.device.type for leaf in leaves if isinstance(leaf, Tensor)}
        assert len(devices) < 2, f"{function} copies between {devices}"
        return result


@pytest.fixture
def copies(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The sizes of what was copied to the host, which gets made-up numbers in its place."""
    sizes = []

    def to_host(values: Tensor) -> Tensor:
        sizes.append(tuple(values.shape))
        if values.dtype.is_floating_point:
            return torch.rand(values.shape)
        return torch.arange(values.numel()).view(values.shape)

    def to_device(pairs: list[Tensor], device: torch.device) -> list[Any]:
        empty = functools.partial(torch.empty, dtype=torch.long, device=device)
        return [(empty(part.shape[1]), empty(part.shape[1])) for part in pairs]

    for module in (matcher, pretrain):
        monkeypatch.setattr(module, "to_host", to_host)
        monkeypatch.setattr(module, "to_device", to_device)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())
    for name in ("tensor", "as_tensor", "from_numpy"):
        monkeypatch.setattr(torch, name, refuse(name, getattr(torch, name)))
    monkeypatch.setattr(Tensor, "new_tensor", refuse("new_tensor", Tensor.new_tensor))
    return sizes


def refuse(name: str, function: Any) -> Any:
    """``function``, but not for a tensor on the device: its values come from the host."""

    def call(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        assert result.device != META, f"{name}{args}: copied from the host"
        return result

    return call


@pytest.mark.parametrize("partition", ["mixed", "all_background", "all_foreground"])
def test_a_prediction_does_not_wait(partition: str, copies: list[Any]) -> None:
    model, batch = tiny_model(partition, [WITHOUT_FILE]).eval().to(META), small_batch(2).to(META)
    with OneDevice():
        _, grid = model.predict(batch)
    assert grid.shape == (2, 256, 256, 32)
    assert copies == []


@pytest.mark.parametrize("transform", ["bounds", "axes"])
@pytest.mark.parametrize("resampling", ["points", "linear"])
def test_full_training_waits_for_the_matcher_alone(
    transform: str, resampling: str, copies: list[Any]
) -> None:
    settings = [f"model.slots.box_transform={transform}"]
    settings += [f"loss.occupancy.objects.resampling={resampling}"]
    assert_waits_once(tiny_stage("full", overrides=[*settings, WITHOUT_FILE]), copies)


@pytest.mark.parametrize("step", [0, 3], ids=["early", "hungarian"])
def test_pretraining_waits_for_the_matcher_alone(step: int, copies: list[Any]) -> None:
    module = tiny_stage("pretrain", overrides=[WITHOUT_FILE])
    module.schedule_steps = 4
    module.pace = SimpleNamespace(position=lambda _: step)
    assert_waits_once(module, copies)


def assert_waits_once(module: Any, copies: list[Any]) -> None:
    module.train().to(META)
    batch = small_batch(2).to(META)
    with OneDevice():
        torch.stack(list(module.losses(batch).values())).sum().backward()
    assert all(p.grad is not None for p in module.parameters() if p.requires_grad)
    assert len(copies) == 1
