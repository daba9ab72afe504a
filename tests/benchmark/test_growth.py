"""The settings of each point of a curve, and their picture."""

import pytest

from occdetr.benchmark.growth import changed
from occdetr.benchmark.growth_plot import draw_growth
from occdetr.cli import entry as cli


@pytest.fixture
def config():
    return cli.compose("benchmark", ["model=tiny", "scaling.slots=[8,128]"])


def test_more_slots_get_the_queries_that_fill_them(config):
    point, work = changed(config, "slots", 8)
    assert (point.model.slots.num_slots, work) == (8, 8)
    assert point.model.detector.selection.num_queries == 128  # at every point
    assert config.model.slots.num_slots == 24


def test_no_more_cells_are_kept_than_there_are(config):
    point, work = changed(config, "kept", 4)
    assert point.model.occupancy_decoder.background.kept == [4096, 24576, 98304]
    assert work == 4096 + 24576 + 98304


def test_image_and_batch(config):
    point, work = changed(config, "image", 0.5)
    assert (list(point.image_size), work) == ([64, 208], 64 * 208)
    assert point.model.image_size == [64, 208]
    assert changed(config, "batch", 4)[0].batch_size == 4


def test_the_same_figures_give_the_same_picture():
    costs = {"latency": [1.0, 2.0, 4.5], "memory": [0.0, 0.0, 0.0]}
    curves = {"slots": {"unit": "slots", "work": [8, 16, 32], "costs": costs}}
    picture = draw_growth(curves, "tiny")
    assert picture.startswith(b"\x89PNG")
    assert picture == draw_growth(curves, "tiny")
