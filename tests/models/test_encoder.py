"""Which levels the encoder's layers update."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from occdetr.errors import InputError
from occdetr.models.encoder import DeformableEncoder
from occdetr.models.layers import AttentionSize

SIZES = [(6, 8), (3, 4), (2, 2)]
FINEST = 48  # tokens


def encoder(layers: int, finest_every: int) -> DeformableEncoder:
    torch.manual_seed(0)
    size = AttentionSize(64, 2, len(SIZES), 2, feedforward_dim=16)
    return DeformableEncoder([4, 8, 16], size, layers, finest_every=finest_every)


def features() -> list[Tensor]:
    generator = torch.Generator().manual_seed(1)
    channels = zip([4, 8, 16], SIZES, strict=True)
    return [torch.randn(2, n, *size, generator=generator) for n, size in channels]


@pytest.mark.parametrize(("layers", "every"), [(6, 3), (5, 3), (2, 4), (3, 1)])
def test_the_last_layer_and_one_of_so_many_update_the_finest_level(layers, every) -> None:
    network, tokens = encoder(layers, every), []
    for layer in network.layers:
        layer.register_forward_hook(lambda _, given, out: tokens.append((given[0], out)))
    memory = network(features())
    assert torch.equal(memory.tokens, tokens[-1][1].tokens)
    for left, (before, after) in zip(range(layers - 1, -1, -1), tokens, strict=True):
        same = (before.tokens == after.tokens).all(2).all(0)
        assert not same[FINEST:].any()
        assert same[:FINEST].all() == (left % every != 0)


def test_every_weight_gets_a_gradient() -> None:
    network = encoder(3, 3)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)  # some are 0, and stop the gradients of others
    tokens = network(features()).tokens
    (tokens * torch.linspace(-1, 1, tokens.numel()).view_as(tokens)).sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


def test_the_only_level_cannot_be_left_out() -> None:
    with pytest.raises(InputError, match="finest_every=2: the only level"):
        DeformableEncoder([4], AttentionSize(32, 2, 1, 2, 16), 2, finest_every=2)
