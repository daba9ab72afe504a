"""Older configurations of the network build today's network."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from model_factory import tiny_config
from occdetr.training.instantiate import build_allowed
from occdetr.training.network_renames import migrate_network
from occdetr.training.renames import migrate

SIZE = {"hidden_dim": 96, "num_heads": 4, "num_levels": 4, "num_points": 2, "feedforward_dim": 192}
STRIDES = [4, 8, 16, 32]


def old_config(partition: str) -> dict[str, Any]:
    """``model=tiny`` as checkpoints of version 0.4 hold it."""
    today = plain(partition)
    classes, masks = today["foreground_classes"], today["mask_classes"]
    models = "occdetr.models"
    size = copy.deepcopy(SIZE)
    selection = {
        "_target_": f"{models}.query_selection.QuerySelection", "image_size": [128, 416],
        "strides": STRIDES, "roi_scale": 2.0, "num_classes": len(classes), "num_queries": 100,
        "hidden_dim": 96, "content": "token",
    }  # fmt: skip
    model = {
        "_target_": f"{models}.occdetr.OccupancyDETR", "image_size": [128, 416],
        "foreground_classes": classes, "num_slots": 24, "enlargement": 1.5, "slot_threshold": 0.05,
        "backbone": {
            "_target_": f"{models}.backbone.ResNet", "depth": 18, "weights": None,
            "freeze_norm": False, "strides": STRIDES,
        },
        "encoder": {
            "_target_": f"{models}.encoder.DeformableEncoder", "in_channels": [64, 128, 256, 512],
            "num_layers": 1, **size,
        },
        "detector": None if not classes else {
            "_target_": f"{models}.detector.Detector", "image_size": [128, 416],
            "num_classes": len(classes), "num_layers": 3, "selection": selection, **size,
        },
        "occupancy_decoder": {
            "_target_": f"{models}.occupancy_decoder.OccupancyDecoder",
            "num_foreground_classes": len(classes), "key_strides": [1, 2, 8], "refine_dim": 32,
            "background_grid": [16, 16, 2] if masks else None, "kept": [2048, 6144, 24576],
            "sight_dim": 32, "object_cells": 32, **size,
        },
        "mask_head": None if not masks else {
            "_target_": f"{models}.mask_head.MaskHead", "num_classes": len(masks),
            "hidden_dim": 96, "num_layers": 2, "num_heads": 4, "feedforward_dim": 192,
            "voxel_dim": 32,
        },
        "fusion": {
            "_target_": f"{models}.fusion.Fusion", "mask_classes": masks,
            "background_threshold": 0.35, "foreground_threshold": 0.35, "score_threshold": 0.2,
        },
    }  # fmt: skip
    criterion = {
        "_target_": "occdetr.losses.detection.DetectionCriterion", "foreground_classes": classes,
        "weight_cls": 0.25, "weight_box2d": 0.6, "weight_giou2d": 0.25, "weight_box3d": 0.125,
        "weight_giou3d": 0.125, "matcher": today["loss"]["detection"]["matcher"],
    }  # fmt: skip
    module = {"detection_criterion": copy.deepcopy(criterion)}
    return {**size, "model": model, "detection_criterion": criterion, "module": module}


def plain(partition: str) -> dict[str, Any]:
    found: Any = OmegaConf.to_container(tiny_config(partition), resolve=True)
    return found


@pytest.mark.parametrize("partition", ["mixed", "all_foreground", "all_background"])
def test_an_old_network_is_todays(partition: str) -> None:
    migrated = migrate(old_config(partition))
    today = plain(partition)
    assert migrated["attention"] == today["attention"]
    assert not set(SIZE) & set(migrated)
    with torch.device("meta"):
        old, new = build_allowed(migrated["model"]), build_allowed(today["model"])
    shapes = [{n: v.shape for n, v in m.state_dict().items()} for m in (old, new)]
    assert shapes[0] == shapes[1]
    assert old.slots == new.slots
    assert old.occupancy_decoder.objects == new.occupancy_decoder.objects
    weights = today["loss"]["detection"]["weights"]
    assert migrated["loss"]["detection"]["weights"] == weights
    assert migrated["module"]["detection_criterion"]["weights"] == weights


def test_what_is_up_to_date_stays() -> None:
    today = plain("mixed")
    same = copy.deepcopy(today)
    migrate_network(same)
    assert same == today
    once = migrate(old_config("mixed"))
    assert migrate(once) == once
