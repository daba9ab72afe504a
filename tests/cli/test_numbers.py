"""Numbers that a setting cannot have are refused in one line that names it, before any work."""

import contextlib

import pytest
from omegaconf import DictConfig, OmegaConf

from malformed_numbers import NO_NUMBERS, wrong_numbers
from occdetr.cli import entry as cli
from occdetr.cli.schema import check_types
from occdetr.cli.user_errors import explain
from occdetr.errors import InputError
from occdetr.training.settings import check_training
from occdetr.training.trainer import make_trainer
from programs import SMALL

CASES = wrong_numbers()


@pytest.fixture(scope="module")
def settings():
    given = ("stage=full", "init_from=scratch", "trainer=cpu", "data=synthetic")
    return cli.compose("train", [*SMALL, *given])


@contextlib.contextmanager
def changed(config, setting, value):
    """The configuration with another value, only inside."""
    before = OmegaConf.select(config, setting)
    OmegaConf.update(config, setting, value, merge=False, force_add=True)
    yield config
    OmegaConf.update(config, setting, before, merge=False)


def make(config, node, folder):
    """What ``train`` makes of a node."""
    if node != "trainer":
        return cli.build(OmegaConf.select(config, node))
    check_training(cli.plain(config.trainer))
    return make_trainer(cli.build(config.trainer, _partial_=True), folder)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_wrong_number_is_named_in_one_line(case, settings, tmp_path):
    with changed(settings, case.setting, case.value), pytest.raises(Exception) as caught:
        check_types(settings)
        make(settings, case.node, tmp_path)
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
        elif type(node[key]) in (int, float):
            yield f"{path}{key}"


def test_no_number_takes_anything_else(settings):
    found = [name for name in numbers(settings) if name != "trainer.devices"]
    assert len(found) > 60
    for name in found:
        for value in NO_NUMBERS[:1]:
            with changed(settings, name, value), pytest.raises(InputError, match=name):
                check_types(settings)
