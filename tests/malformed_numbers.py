"""A generator of numbers that a setting cannot have, by kind: too small, too large, no number.

Where the constructor of a node checks its settings, the case names that node: it alone is made.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

HUGE = 10**9
INF = float("inf")


@dataclass(frozen=True)
class WrongNumber:
    """``setting`` of a training with a ``value`` that must be refused when ``node`` is made."""

    node: str
    setting: str
    value: Any

    @property
    def name(self) -> str:
        return f"{self.setting}={self.value}"


#: By node and setting: the values that are refused.
BY_NODE: dict[str, dict[str, tuple[Any, ...]]] = {
    "attention": {
        "attention.hidden_dim": (-1, 0, HUGE),
        "attention.num_heads": (-1, 0, HUGE),
        "attention.num_levels": (-1, 0, HUGE),
        "attention.num_points": (-1, 0, HUGE),
        "attention.feedforward_dim": (-1, 0, HUGE),
    },
    "model.encoder": {
        "model.encoder.num_layers": (-1, 0, HUGE),
        "model.encoder.dropout": (-1, 1, HUGE, INF),
        "model.encoder.in_channels": ([], [0], [64, 128, 256, HUGE]),
    },
    "model.detector": {
        "model.detector.num_layers": (-1, 0, HUGE),
        "model.detector.dropout": (-1, 1, HUGE, INF),
    },
    "model.detector.selection": {"model.detector.selection.num_queries": (-1, 0, HUGE)},
    "model.detector.selection.rois": {
        "roi_scale": (-1, 0, HUGE, INF),
        "strides": ([], [0], [4, 8, 16, HUGE]),
        "image_size": ([64, HUGE], [64, 0]),
    },
    "model.slots": {
        "model.slots.num_slots": (-1, 0),
        "model.slots.enlargement": (-1, 0, HUGE, INF),
        "model.slots.min_box_size": (-1, HUGE, INF),
        "model.slots.threshold": (-1, 1.5, HUGE, INF),
    },
    "model.occupancy_decoder": {
        "model.occupancy_decoder.objects.cells": (-1, 0, 12, HUGE),
        "model.occupancy_decoder.num_layers": (0, -1, 10**9),
        "model.occupancy_decoder.background.key_grid": ([], [0, 1, 1], [16, 16, 3]),
        "model.occupancy_decoder.background.grid": ([], [16, 16, HUGE]),
        "model.occupancy_decoder.background.kept": ([], [256, 768, 0], [256, 768, HUGE]),
        "model.occupancy_decoder.background.refine_dim": (-1, 0, HUGE),
        "model.occupancy_decoder.background.convolution_dim": (-1, 0, HUGE),
        "model.occupancy_decoder.sight_dim": (-1, 0, HUGE),
    },
    "model.mask_head": {
        "model.mask_head.num_layers": (-1, 0, HUGE),
        "model.mask_head.voxel_dim": (-1, 0, HUGE),
    },
    "model.fusion": {
        "model.fusion.background_threshold": (-1, 1.5, HUGE, INF),
        "model.fusion.foreground_threshold": (-1, 1.5, HUGE, INF),
        "model.fusion.score_threshold": (-1, 1.5, HUGE, INF),
    },
    "data": {
        "data.stride": (-1, 0),
        "data.batch_size": (-1, 0, HUGE),
        "data.num_workers": (-1, HUGE),
        "data.flip": (-1, 1.5, HUGE, INF),
        "data.photometric": (-1, 1, HUGE, INF),
        "data.sensor": (-1, 1.5, HUGE, INF),
        "data.scale": ([], [0], [1.0, -1], [1.0, HUGE]),
        "data.num_train": (-1, 0, HUGE),
        "data.num_val": (-1, 0, HUGE),
        "data.seed": (-1,),
        "data.street_image_size": ([], [0], [124, 0], [124, HUGE]),
        "data.horizontal_fov": (-1, 0, HUGE, INF),
        "data.camera_height": (-1, 0, HUGE, INF),
        "data.camera_pitch": (HUGE, INF),
        "data.training_heights": ([], [-1, 1], [1.0, HUGE]),
        "data.scans_per_world": (-1, 0, HUGE),
        "data.write_workers": (-1, HUGE),
        "data.objects.ray_stride": (-1, 0, HUGE),
        "data.objects.min_visible_pixels": (-1, 0, HUGE),
    },
    "optimizer": {
        "optimizer.lr": (-1, 0, INF),
        "optimizer.weight_decay": (-1, INF),
        "optimizer.betas": ([], [-1], [0.9, 1], [0.9, HUGE]),
        "optimizer.matrix_lr": (-1, 0, INF),
        "optimizer.offset_factor": (-1, INF),
        "optimizer.lr_factors.encoder": (-1, INF),
    },
    "scheduler": {"scheduler.warmup_steps": (-1,)},
    "loss.detection": {
        "loss.detection.weights.cls": (-1, INF),
        "loss.detection.matcher.cost_box": (-1, INF),
    },
    "loss.occupancy": {
        "loss.occupancy.unknown_weight": (-1, 1.5, HUGE, INF),
        "loss.occupancy.weights.mask_dice": (-1, INF),
    },
    "callbacks.checkpoint": {
        "callbacks.checkpoint.every_minutes": (-1, 0),
        "callbacks.checkpoint.every_steps": (-1, 0),
    },
    "callbacks.pictures": {"callbacks.pictures.num_frames": (-1,)},
    "trainer": {
        "trainer.devices": (-1, 0, HUGE, INF, 1.5, "abc", [1], [], True),
        "trainer.num_nodes": (-1, 0, HUGE),
        "trainer.accelerator": ("abc", "cpus", 1),
        "trainer.strategy": ("abc", "DDP", 1),
        "trainer.profiler": (4097, "abc", 1.5, True),
        "trainer.precision": ("abc", 8, "12-mixed"),
        "trainer.max_epochs": (-2, 0),
        "trainer.max_steps": (-2, 0),
        "trainer.gradient_clip_val": (-1, INF),
        "trainer.accumulate_grad_batches": (-1, 0),
        "trainer.check_val_every_n_epoch": (-1, 0),
        "trainer.num_sanity_val_steps": (-2,),
        "trainer.log_every_n_steps": (-1,),
        "trainer.limit_train_batches": (-1, 1.5, INF),
        "trainer.limit_val_batches": (-1, 1.5, INF),
        "trainer.overfit_batches": (-1, 1.5, INF),
        "trainer.gradient_clip_algorithm": ("abc",),
        "trainer.max_time": ("abc",),
        "trainer.fast_dev_run": (-1,),
        "trainer.logger": ("abc", 4097),
        "trainer.callbacks": ("abc", 4097),
    },
}


def wrong_numbers() -> list[WrongNumber]:
    """Every case; the names differ."""
    return [
        WrongNumber(node, setting, value)
        for node, settings in BY_NODE.items()
        for setting, values in settings.items()
        for value in values
    ]
