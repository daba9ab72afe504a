"""Settings of the network and its losses in older checkpoints, in today's names."""

from __future__ import annotations

from typing import Any

Config = dict[str, Any]

_SIZE = ("hidden_dim", "num_heads", "num_levels", "num_points", "feedforward_dim")
_DECODER = "occdetr.models.occupancy_decoder"


def migrate_network(config: Config) -> None:
    """Bring ``model`` and the criteria of a run's configuration up to date, in place.

    Does nothing to a configuration that is up to date.
    """
    model = config.get("model")
    if isinstance(model, dict) and "slots" not in model:
        _migrate_model(config, model)
    _migrate_weights(config)


def _migrate_model(config: Config, model: Config) -> None:
    encoder = model["encoder"]
    size = {"_target_": "occdetr.models.layers.AttentionSize"}
    size |= {name: encoder[name] for name in _SIZE}
    config["attention"] = dict(size)
    for name in _SIZE:
        config.pop(name, None)
    for part in ("encoder", "detector", "occupancy_decoder", "mask_head"):
        if model.get(part):
            for name in _SIZE:
                model[part].pop(name, None)
            model[part]["attention"] = dict(size)
    foreground = model["foreground_classes"]
    if model.get("detector"):
        _migrate_detector(model["detector"], foreground)
    if model.get("mask_head"):
        _list_classes(model["mask_head"], model["fusion"]["mask_classes"])
    layers = len(model["occupancy_decoder"]["key_strides"])
    model["occupancy_decoder"] = _migrated_decoder(model["occupancy_decoder"], foreground)
    model["slots"] = {
        "_target_": "occdetr.models.slots.SlotSelection",
        "num_slots": model.pop("num_slots"),
        "enlargement": model.pop("enlargement"),
        "min_box_size": 2**layers * 0.2,
        "threshold": model.pop("slot_threshold"),
        "box_transform": "bounds",
    }


def _list_classes(part: Config, classes: list[int]) -> None:
    """Only their number was a keyword."""
    del part["num_classes"]
    part["classes"] = classes


def _migrate_detector(detector: Config, classes: list[int]) -> None:
    detector.pop("image_size", None)
    selection = detector["selection"]
    for part in (detector, selection):
        _list_classes(part, classes)
    selection["rois"] = {
        "_target_": "occdetr.geometry.rois.RoiLayout",
        "image_size": selection.pop("image_size"),
        "strides": selection.pop("strides"),
        "scale": selection.pop("roi_scale"),
    }


def _migrated_decoder(old: Config, classes: list[int]) -> Config:
    background = {
        "_target_": f"{_DECODER}.BackgroundCells",
        "grid": old["background_grid"],
        "kept": old["kept"],
        "refine_dim": old.get("refine_dim"),
    }
    return {
        "_target_": old["_target_"],
        "attention": old["attention"],
        "objects": {
            "_target_": f"{_DECODER}.ObjectCells",
            "classes": classes,
            "cells": old["object_cells"],
            "class_scores": True,
        },
        "background": background if old["background_grid"] else None,
        "key_strides": old["key_strides"],
        "sight_dim": old.get("sight_dim"),
    }


def _migrate_weights(config: Config) -> None:
    """``weight_<term>`` of every criterion, wherever it is, become ``weights: {<term>: ...}``."""
    for value in config.values():
        if isinstance(value, dict):
            _migrate_weights(value)
    if str(config.get("_target_", "")).startswith("occdetr.losses."):
        names = [name for name in config if name.startswith("weight_")]
        weights = {name.removeprefix("weight_"): config.pop(name) for name in names}
        if weights:
            config["weights"] = weights
