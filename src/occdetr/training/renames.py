"""Configurations of older checkpoints and runs, in today's form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Classes that have moved: old ``_target_``, new one.
TARGETS = {
    "occdetr.data.datamodule.SyntheticDataModule": "occdetr.streets.datamodule.SyntheticDataModule",
    "occdetr.models.backbone.ResNet": "occdetr.models.resnet.ResNet",
}

#: Keywords of constructors that have been renamed, by the class's present ``_target_``; those that
#: are now None have been dropped.
KEYWORDS: dict[str, dict[str, str | None]] = {
    "occdetr.training.pretrain.PretrainModule": {"criterion": "detection_criterion"},
}

#: Keywords that constructors have gained, with the values that stand for what was before.
ADDED: dict[str, dict[str, Any]] = {
    "occdetr.data.datamodule.SceneDataModule": {"repeats": 1, "extra_roots": []},
    "occdetr.models.encoder.DeformableEncoder": {"finest_every": 1},
    "occdetr.models.fusion.Fusion": {"class_thresholds": False},
    "occdetr.models.occupancy_decoder.BackgroundCells": {"convolution_dim": None},
    "occdetr.streets.datamodule.SyntheticDataModule": {
        **{"repeats": 1, "extra_roots": []},
        "sensor_tilt": False,
    },
}

#: Settings of the whole configuration that are no more; their values stand where they were used.
DROPPED = (
    *("lr", "matrix_lr", "betas", "backbone_lr_factor", "detector_lr_factor", "backbone"),
    *("num_foreground_classes", "num_mask_classes"),
)


def migrate(config: Mapping[str, Any]) -> dict[str, Any]:
    """A run's whole configuration in today's form, whatever the version that wrote it.

    ``config`` is plain (no interpolations) and stays as it is; one of today is returned unchanged.
    """
    config = {key: rename(value) for key, value in config.items() if key not in DROPPED}
    _move_warmup(config)
    _group_losses(config)
    return config


def rename(node: Any) -> Any:
    """``node`` with the classes and keywords of ``TARGETS``, ``KEYWORDS`` and ``ADDED``, at any
    depth."""
    if isinstance(node, list):
        return [rename(value) for value in node]
    if not isinstance(node, Mapping):
        return node
    target = node.get("_target_")
    target = TARGETS.get(target, target) if isinstance(target, str) else target
    names = KEYWORDS.get(target, {}) if isinstance(target, str) else {}
    added = ADDED.get(target, {}) if isinstance(target, str) else {}
    renamed = added | {names.get(key, key): rename(value) for key, value in node.items()}
    if target is not None:
        renamed["_target_"] = target
    return {key: value for key, value in renamed.items() if key is not None}


def _move_warmup(config: dict[str, Any]) -> None:
    """The warm-up was a setting of the optimizer; every schedule was linear."""
    for holder in (config, config.get("module") or {}):
        optimizer = holder.get("optimizer") or {}
        if "warmup_steps" in optimizer:
            holder["scheduler"] = {
                "_target_": "occdetr.training.scheduler.Linear",
                "warmup_steps": optimizer.pop("warmup_steps"),
            }


def _group_losses(config: dict[str, Any]) -> None:
    """Each criterion had a place of its own."""
    for old, new in (("detection_criterion", "detection"), ("occupancy_criterion", "occupancy")):
        if old in config:
            config.setdefault("loss", {})[new] = config.pop(old)
