"""Numbers that a setting cannot have are refused in one line that names it, before any work."""

import copy
import math

import pytest
from omegaconf import DictConfig, OmegaConf

from malformed_numbers import wrong_numbers
from occdetr.cli import entry as cli
from occdetr.cli.schema import check_types
from occdetr.cli.user_errors import explain
from occdetr.errors import InputError
from occdetr.training.settings import check_training
from occdetr.training.trainer import make_trainer
from programs import SMALL

CASES = wrong_numbers()
#: Every second one is in the default suite.
PARAMETERS = [
    pytest.param(case, id=case.name, marks=[pytest.mark.slow] if number % 2 else [])
    for number, case in enumerate(CASES)
]


@pytest.fixture(scope="module")
def settings():
    given = ("stage=full", "init_from=scratch", "trainer=cpu", "data=synthetic")
    return cli.compose("train", [*SMALL, *given])


#: Settings at the root that others take: the message names those.
TAKEN_BY = {
    "backbone_channels": r"model\.encoder\.in_channels",
}


def changed(settings, name, value):
    """The settings with another value of one."""
    config = copy.deepcopy(settings)
    OmegaConf.update(config, name, value, merge=False, force_add=True)
    return config


def make(config, node, folder):
    """What ``train`` makes of a node."""
    if node != "trainer":
        return cli.build(OmegaConf.select(config, node))
    check_training(cli.plain(config.trainer))
    return make_trainer(cli.build(config.trainer, _partial_=True), folder)


@pytest.mark.parametrize("case", PARAMETERS)
def test_a_wrong_number_is_named_in_one_line(case, settings, tmp_path):
    config = changed(settings, case.setting, case.value)

    def start():
        check_types(config)
        make(config, case.node, tmp_path)

    with pytest.raises(Exception) as caught:  # noqa: PT011 - the line is what matters
        start()
    line = explain(caught.value, [], cli.config_dir(), lambda given: settings)
    assert line is not None, caught.value
    assert "\n" not in line
    assert case.setting.rpartition(".")[2] in line
    assert not list(tmp_path.iterdir())


def numbers(node, path=""):
    """The settings that are numbers."""
    for key in node:
        if OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key):
            continue
        if isinstance(node[key], DictConfig):
            yield from numbers(node[key], f"{path}{key}.")
        elif type(node[key]) in (int, float) and f"{path}{key}" != "trainer.devices":
            yield f"{path}{key}"


@pytest.mark.parametrize("part", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in (1, 2))])
def test_no_number_takes_anything_else(part, settings):
    names = list(numbers(settings))
    assert len(names) > 60
    for name in names[part::3]:
        for value in ("abc", [1], math.nan) if part else ("abc",):
            with pytest.raises(InputError, match=TAKEN_BY.get(name.partition(".")[0], name)):
                check_types(changed(settings, name, value))
