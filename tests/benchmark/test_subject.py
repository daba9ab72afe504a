"""What is said of the machine, and of costs on it."""

import pytest
import torch

from occdetr.benchmark.subject import Machine, check_threads, cost_facts
from occdetr.evaluation.limits import DeviceLimits
from occdetr.evaluation.parts import Cost


@pytest.mark.parametrize(("cpu_per_wall", "warned"), [(0.5, True), (0.79, True), (0.95, False)])
def test_threads_that_wait_are_said(cpu_per_wall, warned, capsys):
    machine = Machine(torch.device("cpu"), "32-true")
    check_threads(machine, cpu_per_wall * torch.get_num_threads())
    assert capsys.readouterr().out.startswith("warning: CPU time is") == warned


def test_the_share_of_the_limit():
    limits = DeviceLimits(flops=1e9, bandwidth=1e9)
    latency = {"latency_ms": 8.0}
    computing = cost_facts(Cost(10**6, 10**6, 10**7), latency, limits)
    assert (computing["least_ms"], computing["share_of_limit"]) == (2.0, 0.25)
    moving = cost_facts(Cost(10**6, 4 * 10**6, 10**7), latency, limits)
    assert (moving["least_ms"], moving["share_of_limit"]) == (4.0, 0.5)
    unknown = cost_facts(Cost(10**6, 0, 10**7), latency, limits)
    assert unknown["share_of_limit"] is None
    assert cost_facts(None, latency, limits) == latency
