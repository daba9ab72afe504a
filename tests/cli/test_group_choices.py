"""Choices of groups that Hydra would mix, or end with a traceback."""

import pytest

from occdetr.cli.entry import compose, compose_checked
from occdetr.errors import InputError


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("data=[synthetic,semantickitti]", "takes one option: give data=<name>, or several runs "),
        ("model=[tiny]", "takes one option: give model=<name>"),
        ("model=[tiny],[small]", "takes one option"),
        ("hydra/launcher=[basic]", "takes one option"),
        ("callbacks=[1]", r"takes names of options: give callbacks=\[<name>,<name>\]"),
        ("callbacks=[default,mean,ema]", "mean and ema both set ema: keep one"),
        ("logger=[tensorboard,[csv]]", "takes names of options"),
        ("+experiment=[1]", "takes names of options"),
        ("optimizer.lr_factors=[1]", "give settings, as in {a: 1}"),
        ("image_size={a: b}", r"give a list, as in \[a,b\]"),
    ],
)
def test_a_value_of_another_kind_is_named_with_the_fix(override, line):
    with pytest.raises(InputError, match=line) as caught:
        compose_checked("train", [override])
    assert override.lstrip("+") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_other_lists_are_left_to_hydra():
    chosen = compose("train", ["callbacks=[default,ema]", "logger=[tensorboard,csv]"])
    assert {"checkpoint", "ema"} <= set(chosen.callbacks)
    assert {"tensorboard", "csv"} <= set(chosen.logger)
    assert not compose("train", ["callbacks=[]"]).get("callbacks")
    assert compose("train", ["data.flip=[1]"]).data.flip == [1]
