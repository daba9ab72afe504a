"""The forms of deformable sampling against each other, and the operator's promises to PyTorch."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from occdetr.models.deformable_attention import (
    DeformableAttention,
    deformable_sampling,
    reference_sampling,
)
from occdetr.models.layers import AttentionSize
from occdetr.models.sampling.operators import sample
from occdetr.models.sampling.reference import deformable_sampling_reference
from occdetr.structures import Memory

SHAPES = [(5, 7), (3, 4), (1, 3), (2, 1)]


@dataclass
class Case:
    value: Tensor
    locations: Tensor
    weights: Tensor

    def leaves(self) -> Case:
        """A copy whose tensors take gradients."""
        return Case(*[t.detach().clone().requires_grad_() for t in vars(self).values()])

    def arguments(self) -> tuple[Tensor, list[tuple[int, int]], Tensor, Tensor]:
        return self.value, SHAPES, self.locations, self.weights


def case(queries: int = 9, batch: int = 2, dtype: torch.dtype = torch.float64) -> Case:
    """Locations inside, on the border and outside of four maps, one of them a row."""
    generator = torch.Generator().manual_seed(0)
    heads, channels, points = 3, 5, 2
    tokens = sum(rows * columns for rows, columns in SHAPES)
    value = torch.randn(batch, tokens, heads, channels, generator=generator, dtype=torch.float64)
    size = (heads, len(SHAPES), points)
    locations = torch.rand(batch, queries, 2, *size, generator=generator, dtype=torch.float64)
    locations = locations * 1.6 - 0.3
    if queries:
        locations[:, 0, 0], locations[:, 0, 1] = 0.0, 1.0
        locations[:, 1, 0], locations[:, 1, 1] = 1.0, 0.0
        locations[:, 2] = 1e30
        locations[:, 3, 0] = -1e4
    weights = torch.rand(batch, queries, *size, generator=generator, dtype=torch.float64)
    return Case(value.to(dtype), locations.to(dtype), weights.to(dtype))


def gradients(function, case: Case) -> tuple[Tensor, ...]:
    """The result and the gradients of a weighted sum of it."""
    case = case.leaves()
    result = function(*case.arguments())
    factors = torch.linspace(-1.0, 2.0, result.numel(), dtype=result.dtype).view_as(result)
    return result.detach(), *torch.autograd.grad((result * factors).sum(), vars(case).values())


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize(("queries", "batch"), [(9, 2), (0, 1)])
def test_the_kernel_equals_the_reference(dtype, tolerance, queries, batch) -> None:
    given = case(queries, batch, dtype)
    found = gradients(deformable_sampling, given)
    expected = gradients(deformable_sampling_reference, given)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.dtype == dtype
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=10 * tolerance)


def test_arguments_need_not_be_contiguous() -> None:
    given = case()
    strided = Case(
        given.value.transpose(1, 3).contiguous().transpose(1, 3),
        given.locations.flip(-1).flip(-1).transpose(0, 1).contiguous().transpose(0, 1),
        given.weights.transpose(1, 4).contiguous().transpose(1, 4),
    )
    assert not strided.value.is_contiguous()
    expected = deformable_sampling(*given.arguments())
    assert torch.equal(deformable_sampling(*strided.arguments()), expected)
    expanded = replace(given.leaves(), weights=given.weights)
    deformable_sampling(*expanded.arguments()).sum().backward()  # of one number, expanded
    assert expanded.value.grad is not None


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_a_location_that_is_no_number_spoils_its_query_and_head_alone(number) -> None:
    given = case()
    given.locations[1, 5, 1, 2, 1, 0] = number
    result, *found = gradients(deformable_sampling, given)
    spoiled = torch.zeros(2, 9, 3, 5, dtype=torch.bool)
    spoiled[1, 5, 2] = True
    assert torch.equal(result.isnan(), spoiled.flatten(2))
    assert found[1][1, 5, :, 2, 1, 0].isnan().all()
    assert found[2][1, 5, 2, 1, 0].isnan()
    assert found[0].isfinite().all()


@pytest.mark.parametrize("name", ["locations", "weights", "value"])
def test_sizes_that_contradict_each_other_are_refused(name) -> None:
    wrong = case()
    setattr(wrong, name, getattr(wrong, name)[:, :-1])
    shapes = [side for shape in SHAPES for side in shape]
    with pytest.raises(ValueError, match="sizes"):
        sample(wrong.value, shapes, wrong.locations, wrong.weights)


@pytest.mark.parametrize("shapes", [[3, 4, 0, 5], [3, 4, 5, 0], [-3, -4], []])
def test_maps_without_cells_are_refused(shapes) -> None:
    levels = len(shapes) // 2
    tokens = 12 if shapes else 0
    weights = torch.ones(1, 2, 1, levels, 1)
    locations = torch.full((1, 2, 2, 1, levels, 1), 0.5)
    with pytest.raises(ValueError, match="every side"):
        sample(torch.ones(1, tokens, 1, 3), shapes, locations, weights)


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    given = case(dtype=torch.float32)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            results.append(gradients(deformable_sampling, given))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def _sample_in_child(queue) -> None:
    torch.set_num_threads(2)
    queue.put(deformable_sampling(*case(dtype=torch.float32).arguments()).sum().item())


def test_a_forked_process_makes_its_own_threads() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        expected = deformable_sampling(*case(dtype=torch.float32).arguments()).sum().item()
        context = multiprocessing.get_context("fork")
        queue = context.SimpleQueue()
        child = context.Process(target=_sample_in_child, args=(queue,), daemon=True)
        child.start()
        child.join(timeout=60)
        assert child.exitcode == 0
        assert queue.get() == expected
    finally:
        torch.set_num_threads(before)


def test_half_precision_is_computed_in_float32() -> None:
    given = case(dtype=torch.bfloat16)
    found = deformable_sampling(*given.arguments())
    single = Case(*[t.float() for t in vars(given).values()])
    assert found.dtype == torch.bfloat16
    assert torch.equal(found, deformable_sampling(*single.arguments()).bfloat16())
    result = gradients(deformable_sampling, given)
    assert [t.dtype for t in result] == [torch.bfloat16] * 4


def test_gradcheck_and_opcheck() -> None:
    given = case(queries=4, batch=1).leaves()
    with torch.no_grad():
        given.locations[:, :] = torch.rand(given.locations.shape, dtype=torch.float64) * 0.9
    shapes = [side for shape in SHAPES for side in shape]
    assert torch.autograd.gradcheck(
        lambda value, locations, weights: sample(value, shapes, locations, weights),
        (given.value, given.locations, given.weights),
    )
    torch.library.opcheck(sample, (given.value, shapes, given.locations, given.weights))


def attention_inputs() -> tuple[DeformableAttention, Tensor, Tensor, Memory]:
    torch.manual_seed(0)
    layer = DeformableAttention(AttentionSize(12, 3, len(SHAPES), 2, feedforward_dim=8))
    tokens = sum(rows * columns for rows, columns in SHAPES)
    return (
        layer,
        torch.randn(2, 6, 12),
        torch.rand(2, 6, 4),
        Memory(torch.randn(2, tokens, 12), SHAPES),
    )


ONE_GRAPH = """
import torch
from occdetr.models.deformable_attention import DeformableAttention, reference_sampling
from occdetr.models.layers import AttentionSize
from occdetr.structures import Memory

torch.manual_seed(0)
layer = DeformableAttention(AttentionSize(12, 3, 2, 2, feedforward_dim=8))
memory = Memory(torch.randn(2, 47, 12), [(5, 7), (3, 4)])
inputs = torch.randn(2, 6, 12), torch.rand(2, 6, 4), memory
expected = layer(*inputs)
compiled = torch.compile(layer, backend="aot_eager", fullgraph=True)
found = compiled(*inputs)
torch.testing.assert_close(found, expected)
found.sum().backward()
gradient = layer.sampling_offsets.weight.grad.clone()
layer.zero_grad()
expected.sum().backward()
torch.testing.assert_close(gradient, layer.sampling_offsets.weight.grad)

class Layer(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = layer

    def forward(self, query, reference, tokens):
        return self.layer(query, reference, Memory(tokens, [(5, 7), (3, 4)]))

arguments = *inputs[:2], memory.tokens
exported = torch.export.export(Layer(), arguments)
assert "occdetr.sample" in str(exported.graph)
torch.testing.assert_close(exported.module()(*arguments), expected)
with reference_sampling():
    exported = torch.export.export(Layer(), arguments)
assert "occdetr.sample" not in str(exported.graph)
assert "grid_sampler" in str(exported.graph)
torch.testing.assert_close(exported.module()(*arguments), expected)
"""


def test_new_attention_looks_within_the_reference_boxes_with_equal_weights() -> None:
    size = AttentionSize(32, num_heads=4, num_levels=2, num_points=3, feedforward_dim=32)
    memory = Memory(torch.randn(1, 18, 32), [(3, 5), (1, 3)])
    boxes = torch.tensor([[[0.5, 0.4, 0.2, 0.6], [0.1, 0.9, 0.1, 0.1]]])
    attention = DeformableAttention(size)
    places, weights = attention.sampling_points(torch.randn(1, 2, 32), boxes, memory)
    assert places.shape == (1, 2, 2, 4, 2, 3)
    torch.testing.assert_close(weights, torch.full_like(weights, 1 / 6))
    away = (places - boxes[..., :2, None, None, None]).abs().flatten(3).amax(-1)
    torch.testing.assert_close(away, boxes[..., 2:] / 2)  # the farthest is on the border


def test_attention_is_one_graph_and_exports_with_the_kernel_or_without() -> None:
    """In a process of its own, without the checks of shapes, which the compiler cannot trace."""
    command = [sys.executable, "-c", ONE_GRAPH]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_reference_can_be_forced() -> None:
    given = case()
    with reference_sampling():
        found = deformable_sampling(*given.arguments())
    assert torch.equal(found, deformable_sampling_reference(*given.arguments()))


def test_training_agrees_with_the_reference() -> None:
    """At the start all points lie at the centres of cells, where the gradient has a step."""
    grads = []
    for forced in (False, True):
        layer, query, _, memory = attention_inputs()
        columns = SHAPES[0][1]
        reference = torch.stack([(torch.arange(6) + 0.5) / columns, torch.full((6,), 0.5)], -1)
        reference = reference.expand(2, 6, 2)
        memory = Memory(memory.tokens.requires_grad_(), SHAPES)
        if forced:
            with reference_sampling():
                loss = layer(query, reference, memory).square().sum()
        else:
            loss = layer(query, reference, memory).square().sum()
        grads.append(torch.autograd.grad(loss, [*layer.parameters(), memory.tokens]))
    for ours, theirs in zip(*grads, strict=True):
        assert (ours - theirs).abs().max() <= 1e-5 * theirs.abs().max()
