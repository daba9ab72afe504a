"""Batch norms: only statistics that exist are frozen."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from model_factory import fit_batches, on_backbone_alone, small_batch, tiny_stage
from occdetr.errors import InputError
from occdetr.models.backbone import has_statistics
from occdetr.models.resnet import ResNet

NOTE = "note: the batch norms have no statistics to freeze"


def learning_stage():
    """``stage=full`` with a backbone whose norms learn."""
    return tiny_stage("full", overrides=["backbone=resnet18"])


def running(module) -> list[torch.Tensor]:
    """Means and variances of every batch norm."""
    buffers = module.model.backbone.named_buffers()
    return [value for name, value in buffers if "running" in name]


def statistics(module) -> list[torch.Tensor]:
    return [value.clone() for value in running(module)]


def changed(before, after) -> list[bool]:
    return [not torch.equal(a, b) for a, b in zip(before, after, strict=True)]


def gather(module) -> None:
    """As pretraining does."""
    with torch.no_grad():
        module.model.backbone.train()(small_batch(1).images)


def test_without_statistics_a_full_training_gathers_them(tmp_path, capsys) -> None:
    module = on_backbone_alone(learning_stage())
    fresh = statistics(module)
    trainer = fit_batches(module, [small_batch(1)] * 2, tmp_path)
    once = statistics(module)
    assert all(changed(fresh, once))
    assert capsys.readouterr().out.count(NOTE) == 1
    trainer.save_checkpoint(tmp_path / "scratch.ckpt")
    resumed = on_backbone_alone(learning_stage())
    fit_batches(resumed, [small_batch(1)] * 2, tmp_path, tmp_path / "scratch.ckpt", max_epochs=2)
    assert all(changed(once, statistics(resumed)))  # not frozen by the interruption
    assert NOTE in capsys.readouterr().out


def test_gathered_statistics_are_frozen(tmp_path, capsys) -> None:
    module = on_backbone_alone(learning_stage())
    gather(module)
    before = statistics(module)
    fit_batches(module, [small_batch(1)] * 2, tmp_path)
    assert not any(changed(before, statistics(module)))
    assert NOTE not in capsys.readouterr().out


def test_a_frozen_backbone_is_frozen_in_pretraining(tmp_path) -> None:
    """Lightning does not call ``train()``."""
    module = on_backbone_alone(
        tiny_stage("pretrain", overrides=["model.backbone.freeze_norm=true"])
    )
    with torch.no_grad():
        for value in running(module):
            value.uniform_(0.5, 1.5)
    before = statistics(module)
    fit_batches(module, [small_batch(1)], tmp_path)
    assert not any(changed(before, statistics(module)))


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_a_backbone_cannot_be_frozen_at_random_weights(stage, tmp_path) -> None:
    module = tiny_stage(stage, overrides=["model.backbone.weights=null"])
    with pytest.raises(InputError, match=r"freeze_norm=true: .* give model\.backbone\.weights"):
        fit_batches(module, [small_batch(1)], tmp_path)


def test_synchronised_batch_norms_are_frozen_too() -> None:
    backbone = nn.SyncBatchNorm.convert_sync_batchnorm(ResNet(18, freeze_norm=True))
    backbone.train()
    norms = [part for part in backbone.modules() if isinstance(part, nn.SyncBatchNorm)]
    assert len(norms) == 20
    assert not any(norm.training for norm in norms)


def test_statistics_are_known_by_their_values() -> None:
    backbone = ResNet(18, freeze_norm=False)
    assert not has_statistics(backbone)
    backbone(torch.randn(1, 3, 64, 64))
    assert has_statistics(backbone)
    backbone.bn1.reset_running_stats()
    assert not has_statistics(backbone)  # one is enough
    assert has_statistics(nn.Conv2d(1, 1, 1))  # none to gather
