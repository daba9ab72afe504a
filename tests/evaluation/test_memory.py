"""The memory of tensors, to the byte."""

import torch

from occdetr.evaluation.memory import tensor_memory_mb


def test_the_most_that_is_held_at_a_time(capfd):
    held = torch.zeros(2**18)  # before: not counted

    def function():
        first = held + 1  # 1 MiB
        second = torch.cat([first, first])  # 2 MiB
        del first
        return second.sum() + held.sum()

    assert 3.0 <= tensor_memory_mb(function, torch.device("cpu")) < 3.001
    assert capfd.readouterr().err == ""
