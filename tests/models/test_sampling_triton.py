"""The Triton form of deformable sampling under Triton's interpreter, which needs no GPU."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch
from torch import Tensor

from occdetr.models.sampling.reference import deformable_sampling_reference

pytest.importorskip("triton")

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"  # read when triton is first imported
SHAPES = [(4, 6), (1, 3)]
SIDES = [side for shape in SHAPES for side in shape]


@pytest.mark.skipif(INTERPRETED, reason="this is the process that it starts")
def test_the_triton_form_in_a_process_with_the_interpreter() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider"]
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    done = subprocess.run(
        [*command, __file__], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


@pytest.fixture
def kernels():
    if not INTERPRETED:
        pytest.skip("runs in a process with the interpreter")
    from occdetr.models.sampling import triton_kernels

    return triton_kernels


def arguments(batch: int, queries: int) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(batch, 27, 2, 5, generator=generator, dtype=torch.float64)
    size = (2, len(SHAPES), 3)
    locations = torch.rand(batch, queries, 2, *size, generator=generator, dtype=torch.float64)
    locations = locations * 1.6 - 0.3
    if queries:
        locations[:, 0, 0], locations[:, 0, 1], locations[:, 1] = 0.0, 1.0, 1e30
    weights = torch.rand(batch, queries, *size, generator=generator, dtype=torch.float64)
    return value, locations, weights


@pytest.mark.parametrize(("batch", "queries"), [(2, 35), (1, 0)])
def test_the_triton_form_equals_the_reference(kernels, batch, queries) -> None:
    value, locations, weights = (t.requires_grad_() for t in arguments(batch, queries))
    expected = deformable_sampling_reference(value, SHAPES, locations, weights)
    gradient = torch.linspace(-1.0, 2.0, expected.numel(), dtype=torch.float64).view_as(expected)
    wanted = torch.autograd.grad(expected, (value, locations, weights), gradient)
    given = [t.detach() for t in (value, locations, weights)]
    found = kernels.forward(given[0], SIDES, *given[1:])
    gradients = kernels.backward(gradient, given[0], SIDES, *given[1:])
    torch.testing.assert_close(found, expected.detach(), rtol=1e-12, atol=1e-11)
    for ours, theirs in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-11)


def test_the_triton_form_spoils_what_a_location_that_is_no_number_touches(kernels) -> None:
    value, locations, weights = arguments(1, 4)
    locations[0, 3, 0, 1, 0, 1] = float("nan")
    found = kernels.forward(value, SIDES, locations, weights)
    spoiled = torch.zeros(1, 4, 2, 5, dtype=torch.bool)
    spoiled[0, 3, 1] = True
    assert torch.equal(found.isnan(), spoiled.flatten(2))
    gradients = kernels.backward(torch.ones_like(found), value, SIDES, locations, weights)
    assert gradients[0].isfinite().all()
    assert gradients[2][0, 3, 1, 0, 1].isnan()


def test_the_triton_form_takes_values_of_half_precision(kernels) -> None:
    value, locations, weights = arguments(1, 4)
    given = value.bfloat16(), locations.float(), weights.float()
    found = kernels.forward(given[0], SIDES, *given[1:])
    expected = kernels.forward(given[0].float(), SIDES, *given[1:])
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), expected, rtol=1e-2, atol=1e-2)
    gradients = kernels.backward(found, given[0], SIDES, *given[1:])
    assert [t.dtype for t in gradients] == [torch.bfloat16, torch.float32, torch.float32]
