"""The examples of docs/extending.md: their files are written, their commands composed and run."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from documents import REPOSITORY, code_blocks, commands, read
from model_factory import small_batch
from occdetr.cli import entry as cli

PAGE = read(REPOSITORY / "docs" / "extending.md")
FILES = {
    found[1]: code
    for _, code in code_blocks(PAGE)
    if (found := re.match(r"(?:# @package .*\n)?# ([\w/]+\.(?:py|yaml))\n", code))
}
COMMANDS = dict(enumerate(overrides for _, overrides in commands(PAGE)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The files of the page, where Python finds the modules."""
    folder = tmp_path_factory.mktemp("extensions")
    for name, code in FILES.items():
        if name.startswith("my_"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(code)
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))


def build(folder: Path, word: str):
    """The configuration of the page's one command with ``word``, and its stage."""
    (overrides,) = [own for own in COMMANDS.values() if any(word in option for option in own)]
    search = f"hydra.searchpath=[file://{folder / 'my_conf'}]"  # what --config-dir does
    size = f"image_size={list(small_batch(1).images.shape[-2:])}"
    with initialize_config_dir(str(cli.config_dir()), version_base="1.3"):
        config = compose("train", [search, size, *overrides])
    torch.manual_seed(0)
    return config, cli.build(config.module, model=cli.build(config.model))


def test_every_command_of_the_page_has_a_test_here():
    assert len(COMMANDS) == 5
    assert {name for name in FILES if name.startswith("my_")} == {
        *("my_backbone.py", "my_loss.py", "my_callback.py"),
        *("my_conf/partition/poles_background.yaml", "my_conf/callbacks/epoch_counter.yaml"),
        "my_conf/backbone/conv.yaml",
    }


def test_lines_quoted_from_the_source_are_in_it():
    (name,) = [name for name in FILES if name.startswith("src/")]
    source = (REPOSITORY / name).read_text()
    for line in FILES[name].splitlines()[1:]:
        assert line in source


def test_objects_become_background(folder):
    _, module = build(folder, "poles_background")
    assert module.model.foreground_classes.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    detections, occupancy = parts(module)
    assert detections.final.pred_logits.shape[-1] == 8
    assert occupancy.mask_logits.shape[1] == 19


def test_another_backbone(folder):
    _, module = build(folder, "backbone=conv")
    assert type(module.model.backbone).__module__ == "my_backbone"
    detections, _ = parts(module)
    detections.final.pred_logits.sum().backward()
    gradients = [p.grad for p in module.model.backbone.parameters()]
    assert all(gradient is not None and gradient.any() for gradient in gradients)


def test_fewer_cells_are_kept(folder):
    _, module = build(folder, "kept")
    _, occupancy = parts(module)
    candidates = [level.logits.shape[1] for level in occupancy.levels]
    assert candidates == [8 * 512, 8 * 1024, 8 * 3072, 8 * 12288]


def test_a_loss_term(folder):
    _, module = build(folder, "SharpCriterion")
    losses = module.losses(small_batch(1))
    assert 0 < losses["entropy"] < 0.1 * math.exp(-1)
    assert "background_bce" in losses


def test_a_callback(folder):
    config, _ = build(folder, "epoch_counter")
    callbacks = cli.build(config.callbacks)
    assert callbacks["epoch_counter"].name == "optim/epoch"
    assert len(callbacks) > 1


def parts(module):
    """Detections and occupancy of a random picture."""
    batch = small_batch(1)
    output = module.model.eval()(batch.images, batch.camera)
    return output.detections, output.occupancy
