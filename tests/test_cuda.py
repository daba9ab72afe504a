"""What only a GPU shows; all of it is skipped without one."""

from __future__ import annotations

import copy

import pytest
import torch

from model_factory import small_batch, tiny_model, tiny_stage
from occdetr.models.compilation import compile_network
from occdetr.models.sampling.operators import sample
from occdetr.models.sampling.reference import deformable_sampling_reference

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
CUDA = torch.device("cuda")
SHAPES = [(5, 7), (3, 4), (1, 3), (2, 1)]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
def test_the_kernel_equals_the_reference(dtype: torch.dtype, tolerance: float) -> None:
    torch.manual_seed(0)
    tokens, sides = sum(h * w for h, w in SHAPES), [side for shape in SHAPES for side in shape]
    value = torch.randn(2, tokens, 3, 5, dtype=dtype, device=CUDA, requires_grad=True)
    size = (3, len(SHAPES), 4)
    locations = torch.rand(2, 300, 2, *size, dtype=dtype, device=CUDA) * 1.6 - 0.3
    weights = torch.rand(2, 300, *size, dtype=dtype, device=CUDA, requires_grad=True)
    inputs = (value, locations.requires_grad_(), weights)
    expected = deformable_sampling_reference(value, SHAPES, locations, weights)
    found = sample(value, sides, locations, weights)
    gradient = torch.randn_like(expected)
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)
    for own, other in zip(
        torch.autograd.grad(found, inputs, gradient),
        torch.autograd.grad(expected, inputs, gradient),
        strict=True,
    ):
        torch.testing.assert_close(own, other, rtol=tolerance, atol=tolerance)


def test_a_prediction_is_that_of_the_cpu() -> None:
    model, batch = tiny_model().eval(), small_batch(2)
    expected, expected_grid = model.predict(batch)
    found, grid = model.to(CUDA).predict(batch.to(CUDA))
    boxes, expected_boxes = (x.detections.final.pred_boxes for x in (found, expected))
    torch.testing.assert_close(boxes.cpu(), expected_boxes, rtol=1e-2, atol=1e-2)
    assert (grid.cpu() == expected_grid).float().mean() > 0.999


def test_a_prediction_does_not_wait_for_the_device() -> None:
    model, batch = tiny_model().eval().to(CUDA), small_batch(1).to(CUDA)
    expected = model.predict(batch)[1]  # which compiles the kernels
    torch.cuda.set_sync_debug_mode("error")
    try:
        grid = model.predict(batch)[1]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(grid, expected)


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_a_training_step_waits_once(stage: str) -> None:
    module, batch = tiny_stage(stage).train().to(CUDA), small_batch(2).to(CUDA)

    def step() -> None:
        torch.stack(list(module.losses(batch).values())).sum().backward()

    step()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with pytest.warns(UserWarning, match="synchronizing") as warned:
            step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len(warned) == 1, [str(each.message) for each in warned]


def test_a_prediction_is_replayed_as_a_cuda_graph() -> None:
    model, batch = tiny_model().eval().to(CUDA), small_batch(1).to(CUDA)
    expected = model.predict(batch)[1]
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        grid = model.predict(batch)[1]
    grid.zero_()
    graph.replay()
    assert torch.equal(grid, expected)


def test_the_compiled_network_is_one_graph_and_equals_the_eager_one() -> None:
    model, batch = tiny_model().eval().to(CUDA), small_batch(1).to(CUDA)
    compiled = copy.deepcopy(model)
    expected = model.predict(batch)[1]
    compile_network(compiled, CUDA)
    assert (compiled.predict(batch)[1] == expected).float().mean() > 0.99
