"""Muon moves matrices by orthogonal steps, and leaves everything else to AdamW."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from model_factory import tiny_model
from occdetr.training.muon import MuonAdamW, iterate, iterate_gram, orthogonalize
from occdetr.training.optimizer import OptimizerSettings, make_optimizer, parameter_groups


@pytest.mark.parametrize("shape", [(48, 48), (96, 24), (24, 96)])
def test_orthogonalised_matrices_keep_their_directions(shape):
    torch.manual_seed(0)
    matrices = torch.randn(3, *shape)
    result = orthogonalize(matrices).float()
    for matrix, changed in zip(matrices, result, strict=True):
        u, values, v = torch.linalg.svd(matrix, full_matrices=False)
        stretched = torch.linalg.svdvals(changed)
        assert stretched.max() < 1.3
        assert stretched[values > 0.2 * values.max()].min() > 0.6
        assert torch.nn.functional.cosine_similarity(changed.flatten(), (u @ v).flatten(), 0) > 0.95


@pytest.mark.parametrize("shape", [(32, 40), (32, 64), (24, 216), (216, 24)])
def test_small_matrices_take_the_same_steps_as_the_whole(shape):
    """In float32, against the plain iteration in float64; some singular values are tiny."""
    torch.manual_seed(0)
    u, values, v = torch.linalg.svd(torch.randn(2, *shape).double(), full_matrices=False)
    values[:, 10:] *= 1e-2
    matrices = u * values[:, None] @ v
    wide = matrices.mT if shape[0] > shape[1] else matrices
    expected = iterate(wide / wide.norm(dim=(1, 2), keepdim=True))
    expected = expected.mT if shape[0] > shape[1] else expected
    found = orthogonalize(matrices.float())
    assert found.is_contiguous()
    assert (found - expected).abs().max() < 1e-4
    for alone, together in zip(matrices.float(), found, strict=True):
        assert torch.allclose(orthogonalize(alone[None])[0], together, atol=1e-5)


def test_the_form_for_gpus_differs_by_the_rounding_of_bf16():
    torch.manual_seed(0)
    x = torch.randn(2, 24, 216)
    x /= x.norm(dim=(1, 2), keepdim=True)
    plain, small = iterate(x.bfloat16()).float(), iterate_gram(x)
    assert (plain - small).norm() < 0.1 * small.norm()


def test_matrices_of_any_scale_get_the_same_step():
    torch.manual_seed(0)
    matrices = torch.randn(1, 32, 64)
    assert torch.allclose(orthogonalize(matrices), orthogonalize(1e-6 * matrices), atol=0.05)
    assert not orthogonalize(torch.zeros(1, 32, 64)).any()


def network():
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Linear(12, 16), nn.ReLU(), nn.Linear(16, 16), nn.ReLU(), nn.Linear(16, 1)
    )


def train(net, optimizer, steps):
    torch.manual_seed(1)
    data = torch.randn(64, 12)
    for _ in range(steps):
        loss = (net(data).squeeze(1) - data.prod(1).sign()).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return loss.item()


def test_without_matrices_it_is_adamw():
    mine, theirs = network(), network()
    train(mine, MuonAdamW([{"params": list(mine.parameters())}], lr=1e-2, weight_decay=0.1), 5)
    train(theirs, torch.optim.AdamW(theirs.parameters(), lr=1e-2, weight_decay=0.1), 5)
    for own, other in zip(mine.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(own, other, rtol=1e-5, atol=1e-7)


def orthogonal_optimizer(net):
    middle = net[2].weight
    rest = [p for p in net.parameters() if p is not middle]
    return MuonAdamW(
        [{"params": rest}, {"params": [middle], "orthogonal": True, "lr": 0.02}],
        lr=1e-2,
        weight_decay=0.0,
    )


def test_a_step_of_a_matrix_is_orthogonal_and_of_its_rate():
    net = network()
    before = copy.deepcopy(net)
    train(net, orthogonal_optimizer(net), 1)
    change = torch.linalg.svdvals(net[2].weight - before[2].weight)
    assert change.max() < 0.02 * 1.3
    assert change.median() > 0.02 * 0.6
    assert not torch.equal(net[0].weight, before[0].weight)


def test_it_learns_and_goes_on_from_its_state():
    whole, halves = network(), network()
    first = train(whole, optimizer := orthogonal_optimizer(whole), 1)
    train(whole, optimizer, 9)
    assert train(whole, optimizer, 30) < 0.7 * first
    train(halves, optimizer := orthogonal_optimizer(halves), 1)
    train(halves, optimizer, 9)
    resumed = orthogonal_optimizer(halves)
    resumed.load_state_dict(optimizer.state_dict())
    train(halves, resumed, 30)
    for own, other in zip(whole.parameters(), halves.parameters(), strict=True):
        assert torch.equal(own, other)


def test_states_of_older_versions_go_on_with_one_kernel():
    whole, halves = network(), network()
    train(whole, optimizer := orthogonal_optimizer(whole), 3)
    train(halves, optimizer_of_half := orthogonal_optimizer(halves), 3)
    state = optimizer_of_half.state_dict()
    for group in state["param_groups"]:
        del group["fused"]
    resumed = orthogonal_optimizer(halves)
    resumed.load_state_dict(state)
    train(whole, optimizer, 3)
    train(halves, resumed, 3)
    assert [group["fused"] for group in resumed.param_groups] == [True, False]
    for own, other in zip(whole.parameters(), halves.parameters(), strict=True):
        assert torch.equal(own, other)


def names_of(model, groups, orthogonal):
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    return {names[id(p)] for g in groups if g["orthogonal"] == orthogonal for p in g["params"]}


def test_hidden_matrices_go_to_muon():
    model = tiny_model(overrides=["backbone=resnet18"])
    settings = OptimizerSettings(matrix_lr=0.01, lr=1e-3, lr_factors={"backbone": 0.5})
    groups = parameter_groups(model, settings)
    mine = names_of(model, groups, orthogonal=True)
    rest = names_of(model, groups, orthogonal=False)
    assert mine | rest == {name for name, _ in model.named_parameters()}
    assert "backbone.layer2.0.conv1.weight" in mine
    assert "encoder.layers.0.feed_forward.linear1.weight" in mine
    assert "occupancy_decoder.layers.0.self_attention.query_proj.weight" in mine
    assert "mask_head.layers.0.cross_attention.value_proj.weight" in mine
    assert "backbone.conv1.weight" in rest  # the first layer
    assert "backbone.layer4.1.conv2.weight" in rest  # too large
    assert "mask_head.query_feat.weight" in rest
    assert not any("head" in n.removeprefix("mask_head") or n.endswith("bias") for n in mine)
    rates = {(g["orthogonal"], g["lr"]) for g in groups}
    assert rates == {(True, 0.01), (True, 0.005), (False, 1e-3), (False, 5e-4)}


def test_a_part_can_be_left_to_adamw():
    model = tiny_model()
    settings = OptimizerSettings(matrix_lr=0.01, adamw_parts=["backbone"])
    names = names_of(model, parameter_groups(model, settings), orthogonal=True)
    assert names
    assert not any(name.startswith("backbone.") for name in names)
    assert "backbone.blocks.9.expand.0.weight" in names_of(
        model, parameter_groups(model, OptimizerSettings(matrix_lr=0.01)), orthogonal=True
    )


def test_without_a_rate_for_matrices_all_is_adamws():
    model = tiny_model()
    optimizer = make_optimizer(model, OptimizerSettings(betas=(0.8, 0.9)))
    assert not names_of(model, optimizer.param_groups, orthogonal=True)
    assert all(group["betas"] == (0.8, 0.9) for group in optimizer.param_groups)


@pytest.mark.parametrize("matrix_lr", [None, 0.01])
def test_weight_decay_is_for_matrices_and_kernels(matrix_lr):
    model = tiny_model()
    groups = parameter_groups(model, OptimizerSettings(matrix_lr=matrix_lr, weight_decay=0.01))
    assert {group["weight_decay"] for group in groups} == {0.0, 0.01}
    decayed = {id(p) for group in groups if group["weight_decay"] for p in group["params"]}
    embeddings = {
        f"{name}.weight" for name, m in model.named_modules() if isinstance(m, nn.Embedding)
    }
    assert embeddings
    for name, parameter in model.named_parameters():
        matrix = parameter.ndim > 1 and name not in embeddings
        assert (id(parameter) in decayed) == matrix, name
