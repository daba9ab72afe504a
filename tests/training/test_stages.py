"""Training learns, schedules and checkpoints do what they say."""

from __future__ import annotations

import math

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import LambdaCallback
from torch.utils.data import DataLoader

from model_factory import small_batch, tiny_model, tiny_stage
from occdetr.errors import InputError
from occdetr.evaluation.recall import FOUND_SCORE
from occdetr.training import pretrain
from occdetr.training.callbacks import ValidationRecord
from occdetr.training.checkpoint import load_exactly, read_checkpoint
from occdetr.training.optimizer import OptimizerSettings, make_optimizer, moved_state
from occdetr.training.scheduler import Constant, Cosine, Linear, Pace, make_scheduler


def overfit(module, losses, steps: int, lr: float) -> tuple[dict, dict]:
    """The terms before and after ``steps`` on one batch."""
    batch = small_batch(1)
    optimizer = torch.optim.AdamW(module.model.parameters(), lr=lr)
    module.train()
    first = last = {}
    for step in range(steps):
        terms = losses(batch)
        last = {name: value.item() for name, value in terms.items()}
        first = first or last
        optimizer.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(module.model.parameters(), 10.0)
        optimizer.step()
        assert all(value == value for value in last.values()), f"step {step}"
    return first, last


def test_pretraining_overfits_one_batch() -> None:
    module = tiny_stage("pretrain")

    def losses(batch):
        output, layers, proposals = module.match(batch)
        return module.detection_criterion(output, batch.targets, layers, proposals)

    first, last = overfit(module, losses, steps=40, lr=1e-3)
    assert last["cls"] < 0.3 * first["cls"]
    assert last["box2d"] + last["giou2d"] < 0.7 * (first["box2d"] + first["giou2d"])
    assert last["box3d"] < 0.3 * first["box3d"]


def test_full_training_overfits_one_batch() -> None:
    module = tiny_stage("full")
    first, last = overfit(module, module.losses, steps=15, lr=1e-3)
    assert last["background_bce"] < 0.8 * first["background_bce"]
    assert last["mask_ce"] < 0.7 * first["mask_ce"]
    assert last["mask_focal"] < 0.7 * first["mask_focal"]


def fit(share, folder, stop_after=None, resume=None, steps=1, callbacks=()):
    """Five epochs of so many steps; the module, and what it has recorded of its validations."""
    settings = [f"early_matching_share={share}", "scheduler.warmup_steps=0"]
    module = tiny_stage("pretrain", overrides=settings)
    record = ValidationRecord()

    def stop(trainer, _):
        trainer.should_stop = trainer.current_epoch + 1 == stop_after

    fitter = lightning.Trainer(
        **{"max_epochs": 5, "accelerator": "cpu", "logger": False, "num_sanity_val_steps": 0},
        **{"enable_checkpointing": False, "enable_progress_bar": False},
        **{"enable_model_summary": False, "log_every_n_steps": 1},
        callbacks=[record, LambdaCallback(on_train_epoch_end=stop), *callbacks],
        default_root_dir=folder,
    )
    batches = DataLoader([small_batch(1)] * steps, batch_size=None)
    validation = DataLoader([small_batch(1)], batch_size=None)
    fitter.fit(module, batches, validation, ckpt_path=resume, weights_only=True)
    return fitter, record.validations


def test_what_counts_as_found_is_not_what_fusion_writes() -> None:
    """Or else a study's recall would change with a threshold of another part."""
    writes_little = ["model.fusion.score_threshold=0.9"]
    pretraining = tiny_stage("pretrain", overrides=writes_little)
    evaluator = tiny_stage("full", overrides=writes_little).evaluator
    metrics = (pretraining.evaluator.detection, evaluator.detection, evaluator.recall)
    assert {metric.score_threshold for metric in metrics} == {FOUND_SCORE}


@pytest.mark.parametrize(("share", "early"), [(0.0, []), (0.5, [0, 1, 2]), (1.0, [0, 1, 2, 3, 4])])
def test_early_matching_lasts_for_its_share_of_the_steps(share, early, tmp_path, monkeypatch):
    seen = watch_early_matching(monkeypatch)
    _, validations = fit(share, tmp_path)
    assert seen == early
    assert [validation["step"] for validation in validations] == [1, 2, 3, 4, 5]
    assert all(0 <= validation["AP50"] <= 1 for validation in validations)


@pytest.mark.parametrize(("stopped", "left"), [(2, [2]), (4, [])])
def test_a_resumed_run_goes_on_with_early_matching(stopped, left, tmp_path, monkeypatch):
    fitter, _ = fit(0.5, tmp_path, stop_after=stopped)
    fitter.save_checkpoint(tmp_path / "middle.ckpt")
    seen = watch_early_matching(monkeypatch)
    _, validations = fit(0.5, tmp_path, resume=tmp_path / "middle.ckpt")
    assert seen == left
    assert [validation["step"] for validation in validations] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("before", "after", "early", "rates"),
    [
        (2, 1, [4, 5], [0.6, 0.4, 0.2]),
        (1, 2, [2, 3, 4, 5], [0.6, 0.5, 0.4, 0.3, 0.2, 0.1]),
    ],
)
def test_a_run_resumed_with_other_steps_an_epoch_keeps_its_schedule(
    before, after, early, rates, tmp_path, monkeypatch
):
    """As with another batch size or number of devices; 2 of 5 epochs are over."""
    fitter, _ = fit(0.7, tmp_path, stop_after=2, steps=before)
    fitter.save_checkpoint(tmp_path / "middle.ckpt")
    seen, matched = [], watch_early_matching(monkeypatch)

    def note(trainer, *_):
        (group, *_) = trainer.optimizers[0].param_groups
        seen.append(group["lr"] / group["initial_lr"])

    watch = LambdaCallback(on_train_batch_start=note)
    fit(0.7, tmp_path, resume=tmp_path / "middle.ckpt", steps=after, callbacks=[watch])
    assert seen == pytest.approx(rates)
    assert matched == early


def watch_early_matching(monkeypatch):
    """A list of the steps (from 0) that match early: all layers then share one assignment."""
    seen, match = [], pretrain.PretrainModule.match

    def watched(module, *arguments):
        output, layers, proposals = match(module, *arguments)
        if all(layer is layers[0] for layer in layers):
            seen.append(module.global_step)
        return output, layers, proposals

    monkeypatch.setattr(pretrain.PretrainModule, "match", watched)
    return seen


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_a_share_is_from_0_to_1(share):
    with pytest.raises(Exception, match="give 0 to 1") as caught:
        tiny_stage("pretrain", overrides=[f"early_matching_share={share}"])
    assert isinstance(caught.value.__cause__, InputError)


def test_learning_rates_rise_then_fall_to_zero() -> None:
    model = tiny_model()
    settings = OptimizerSettings(lr=1e-3, lr_factors={"backbone": 0.1})
    optimizer = make_optimizer(model, settings)
    schedule = make_scheduler(optimizer, Linear(warmup_steps=9), total_steps=100)
    seen = []
    for _ in range(100):
        seen.append(max(group["lr"] for group in optimizer.param_groups))
        optimizer.step()
        schedule.step()
    assert seen[0] == pytest.approx(1e-4)
    assert max(seen) == pytest.approx(1e-3)
    assert seen.index(max(seen)) == 9
    assert seen[-1] < 2e-5
    backbone = {id(p) for p in model.backbone.parameters()}
    for group in optimizer.param_groups:
        own = {id(p) in backbone for p in group["params"]}
        assert len(own) == 1
        assert group["initial_lr"] == pytest.approx(1e-4 if own.pop() else 1e-3)


def test_a_schedule_goes_on_with_the_samples_seen() -> None:
    """Resumed after 6 of 20 steps, 10 an epoch, with a batch of twice the size."""
    begun, resumed = Pace(10), Pace(10, start=6, step=6, rate=2)
    assert [begun.position(step) for step in range(20)] == list(range(20))
    assert (begun.total_steps(2, -1), resumed.total_steps(2, -1)) == (20, 20)
    assert [resumed.position(step) for step in (6, 7, 13)] == [6, 8, 20]
    assert resumed.total_steps(2, 10) == 14
    assert resumed.total_steps(-1, -1) == math.inf


def test_an_optimizers_state_follows_its_parameters_into_other_groups() -> None:
    model = tiny_model()
    old = OptimizerSettings(lr=1e-3, weight_decay=0.1, matrix_lr=0.01)
    new = OptimizerSettings(lr=2e-3, weight_decay=0.0, matrix_lr=0.01, lr_factors={"encoder": 0.5})
    first = make_optimizer(model, old)
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for number, parameter in enumerate(trained):
        parameter.grad = torch.full_like(parameter, float(number + 1))
    first.step()
    second = make_optimizer(model, new)
    second.load_state_dict(moved_state(model, first.state_dict(), old, new))
    for parameter in trained:
        for name, value in first.state[parameter].items():
            assert torch.equal(second.state[parameter][name], value)
    assert len(first.param_groups) != len(second.param_groups)
    assert {group["weight_decay"] for group in second.param_groups} == {0.0}
    with pytest.raises(InputError, match="between Muon and AdamW"):
        moved_state(model, first.state_dict(), old, OptimizerSettings())


def test_schedules_after_the_warm_up() -> None:
    steps = range(100)
    constant, cosine = Constant(warmup_steps=9), Cosine(warmup_steps=9)
    rise = [constant.factor(step, 100) for step in steps[:10]]
    assert rise == pytest.approx([(step + 1) / 10 for step in range(10)])
    assert {constant.factor(step, 100) for step in steps[9:]} == {1.0}
    expected = [(1 + math.cos(math.pi * (step - 9) / 91)) / 2 for step in steps[9:]]
    assert [cosine.factor(step, 100) for step in steps[9:]] == pytest.approx(expected)
    assert cosine.factor(100, 100) == pytest.approx(0, abs=1e-12)


def test_checkpoints_are_read_safely(tmp_path) -> None:
    model = tiny_model()
    state = {f"model.{name}": value for name, value in model.state_dict().items()}
    path = tmp_path / "last.ckpt"
    about = {"config": {"model_name": "tiny"}, "stage": "full", "version": "0"}
    torch.save({"state_dict": state, "occdetr": about}, path)
    checkpoint = read_checkpoint(path)
    other = tiny_model()
    with torch.no_grad():
        other.encoder.level_embed.zero_()
    load_exactly(other, checkpoint)
    assert torch.equal(other.encoder.level_embed, model.encoder.level_embed)
    del checkpoint.model_state["encoder.level_embed"]
    with pytest.raises(InputError, match=r"1 weights missing, first encoder\.level_embed"):
        load_exactly(other, checkpoint)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="not a readable checkpoint"):
        read_checkpoint(path)
    torch.save({"weights": torch.zeros(1)}, path)
    with pytest.raises(InputError, match=r"not written by occdetr\.train"):
        read_checkpoint(path)


class Sly:
    """Runs code when unpickled by a careless reader."""

    def __reduce__(self):
        return (open, ("sly.txt", "w"))


def test_a_checkpoint_cannot_run_code(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": {}, "occdetr": Sly()}, "sly.ckpt")
    with pytest.raises(InputError):
        read_checkpoint("sly.ckpt")
    assert not (tmp_path / "sly.txt").exists()
