"""Growth of costs, and the work of drawing objects."""

import pytest
import torch

from model_factory import small_batch, tiny_model
from occdetr.benchmark.work import exponent, last_exponent, no_worse_than_linear, with_objects

WORK = [1, 2, 4, 8, 16]


@pytest.mark.parametrize("power", [0, 0.5, 1, 2])
def test_a_power_is_found(power):
    costs = [3.0 * work**power for work in WORK]
    assert exponent(WORK, costs) == pytest.approx(power, abs=1e-9)
    assert no_worse_than_linear(WORK, costs) == (power <= 1)


def test_a_constant_does_not_hide_a_square():
    costs = [100.0 + work**2 for work in WORK]
    assert exponent(WORK, costs) < 1
    assert last_exponent(WORK, costs) > 1.1
    assert not no_worse_than_linear(WORK, costs)


def test_costs_of_nothing_do_not_grow():
    assert no_worse_than_linear(WORK, [0, 0, 0, 0, 0])


def test_the_fusion_draws_as_many_objects_as_asked():
    model, batch = tiny_model().eval(), small_batch(1)
    with torch.no_grad():
        output = model(batch.images, batch.camera).occupancy
        output.foreground_logits.fill_(10.0)
        background = model.fusion(with_objects(output, 0))
        drawn = [(model.fusion(with_objects(output, n)) != background).sum() for n in (1, 2, 4)]
    assert 0 < drawn[0] < drawn[1] < drawn[2]
