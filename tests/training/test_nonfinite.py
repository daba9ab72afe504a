"""Trainings stop at the first loss or gradient that is not finite, before it changes a weight."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from lightning.pytorch.callbacks import LambdaCallback
from lightning.pytorch.plugins.precision import MixedPrecision

from model_factory import fit_batches, on_backbone_alone, small_batch, tiny_stage
from occdetr.errors import InputError
from occdetr.losses.matcher import HungarianMatcher
from occdetr.training.nonfinite import FILE, KEY


def named_batches(*names: str) -> list:
    """One frame each; that of the name ``bad`` has a pixel that is not a number."""
    batches = []
    for seed, name in enumerate(names):
        batch = small_batch(1, seed=seed)
        batch.frame_ids = [name]
        if name == "bad":
            batch.images[0, 0, 0, 0] = math.nan
        batches.append(batch)
    return batches


def stop(module, batches, folder, **given) -> tuple[str, dict]:
    """The one line of a training that must stop, and the file that it leaves."""
    with pytest.raises(InputError) as caught:
        fit_batches(module, batches, folder, **given)
    line = str(caught.value)
    assert "\n" not in line
    assert str(folder / FILE) in line
    return line, torch.load(folder / FILE, weights_only=True)


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_a_loss_that_is_not_finite_stops_a_stage(stage, tmp_path) -> None:
    module = tiny_stage(stage)
    line, file = stop(module, named_batches("good", "bad", "good"), tmp_path)
    for part in ("step 2, epoch 0: loss cls is nan in the frames bad", "optimizer.lr"):
        assert part in line
    assert "32-true" not in line  # it is used already
    assert file["global_step"] == 1
    weights = [value for name, value in file["state_dict"].items() if "running" not in name]
    assert all(torch.isfinite(value).all() for value in weights)
    (batch,) = file[KEY]["batches"]
    assert (batch["rank"], batch["batch_idx"], batch["frame_ids"]) == (0, 1, ["bad"])
    assert math.isnan(batch["losses"]["cls"])


def test_the_file_reproduces_what_was_found(tmp_path) -> None:
    """With dropout, which depends on the random state."""
    settings = ["model.detector.dropout=0.5", "model.encoder.dropout=0.5"]
    module = tiny_stage("pretrain", overrides=settings)
    losses, scale = module.losses, 1.0

    def overflowing(batch):
        found = losses(batch)
        return {**found, "cls": found["cls"] * scale, "draw": found["cls"].detach()}

    module.losses = overflowing

    def explode(trainer, module, *_):
        nonlocal scale
        scale = math.inf if trainer.global_step == 1 else 1.0

    callback = LambdaCallback(on_train_batch_start=explode)
    batches = named_batches("first", "second")
    line, file = stop(module, batches, tmp_path, callbacks=[callback])
    assert "loss cls is inf in the frames second" in line
    (batch,) = file[KEY]["batches"]
    again = tiny_stage("pretrain", overrides=settings)
    again.load_state_dict(file["state_dict"])
    torch.set_rng_state(batch["random_state"]["cpu"])
    assert again.losses(batches[1])["cls"].item() == batch["losses"]["draw"]


def test_accumulated_batches_are_all_checked(tmp_path) -> None:
    module = on_backbone_alone(tiny_stage("pretrain"))
    names = ("good", "other", "bad", "last")
    line, file = stop(module, named_batches(*names), tmp_path, accumulate_grad_batches=2)
    assert "step 2, epoch 0: loss mean is nan in the frames bad: " in line
    assert [batch["frame_ids"] for batch in file[KEY]["batches"]] == [["bad"], ["last"]]


def bad_gradient(module) -> str:
    """Make one gradient infinite, though the loss is finite; returns its name."""
    name = "model.backbone.stem.0.weight"
    parameter = module.get_parameter(name)
    parameter.register_hook(lambda gradient: gradient * math.inf)
    return name


def test_a_gradient_that_is_not_finite_stops(tmp_path) -> None:
    module = on_backbone_alone(tiny_stage("pretrain"))
    name = bad_gradient(module)
    before = copy.deepcopy(module.state_dict())
    clipped = {"gradient_clip_val": 10.0, "precision": "bf16-mixed"}
    line, file = stop(module, named_batches("one"), tmp_path, **clipped)
    assert f"step 1, epoch 0: the gradient of {name} is " in line
    assert "trainer.precision=32-true (now bf16-mixed)" in line
    for key, value in module.named_parameters():
        assert torch.equal(value, before[key])
    assert file[KEY]["term"] == f"the gradient of {name}"


def test_a_gradient_scaler_skips_the_step(tmp_path) -> None:
    module = tiny_stage("pretrain")
    convolution = module.model.backbone.stem[0]  # alone: float16 is slow on a CPU
    module.losses = lambda batch: {"mean": convolution(batch.images).float().mean()}
    bad_gradient(module)
    before = copy.deepcopy(module.state_dict())
    plugin = MixedPrecision("16-mixed", "cpu")
    fit_batches(module, named_batches("one"), tmp_path, plugins=[plugin])
    assert plugin.scaler.get_scale() < 65536.0
    for key, value in module.named_parameters():
        assert torch.equal(value, before[key])


def test_the_matcher_leaves_what_is_not_finite_for_last() -> None:
    logits = torch.tensor([[[0.0], [math.nan], [1.0]]])
    boxes = torch.tensor([[[0.5, 0.5, 0.2, 0.2], [0.5, 0.5, 0.2, 0.2], [math.inf] * 4]])
    matcher = HungarianMatcher(2.0, 5.0, 2.0)
    truth = boxes[0, :1]
    [[(rows, _)]] = matcher([logits], [boxes], [torch.tensor([0])], [truth])
    assert rows.tolist() == [0]
    classes, truth = [torch.tensor([0, 0])], truth.repeat(2, 1)
    [[(rows, columns)]] = matcher([logits * math.nan], [boxes], classes, [truth])
    assert len(rows) == len(columns) == 2
