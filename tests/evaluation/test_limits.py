"""The limits of a device, and the time that they allow."""

import torch

from occdetr.evaluation import limits
from occdetr.evaluation.limits import DeviceLimits, measure_limits


def test_the_slower_of_computing_and_moving_counts():
    device = DeviceLimits(flops=100.0, bandwidth=10.0)
    assert device.least_seconds(macs=100, bytes_moved=10) == 2.0
    assert device.least_seconds(macs=100, bytes_moved=50) == 5.0


def test_a_device_is_measured(monkeypatch):
    monkeypatch.setattr(limits, "REPEATS", 1)
    monkeypatch.setattr(limits, "COPIED_BYTES", 2**20)
    found = measure_limits(torch.device("cpu"), torch.float32)
    assert found.flops > 1e8
    assert found.bandwidth > 1e7
