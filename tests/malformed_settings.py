"""A generator of malformed settings: impossible, contradictory, without effect, of a wrong type.

The last override of a case is the setting that the line on stderr must name.
"""

from __future__ import annotations

from pathlib import Path

from malformed import Malformed
from programs import SMALL

FULL = (*SMALL, "stage=full", "init_from=scratch", "trainer=cpu")
PRETRAIN = (*SMALL, "stage=pretrain", "trainer=cpu")
CELLS = "model.occupancy_decoder"

#: By kind: the overrides before, and the settings that are wrong beside them.
TRAINING = {
    "network": (
        FULL,
        (
            "model.slots.num_slots=0",
            "model.slots.num_slots=101",
            "model.slots.threshold=1.5",
            "model.slots.enlargement=0",
            "model.detector.selection.num_queries=0",
            "model.detector.selection.num_queries=100000",
            "model.detector.selection.hidden_dim=64",
            "model.detector.num_layers=0",
            "model.detector.dropout=1",
            "model.encoder.num_layers=0",
            "model.encoder.in_channels=[64,128,256]",
            "model.encoder.in_channels=[]",
            "model.mask_head.num_layers=-1",
            "model.mask_head.num_layers=1000000000",
            "attention.num_points=1000000000",
            "model.mask_head.voxel_dim=8",
            "model.fusion.score_threshold=-0.1",
            "attention.hidden_dim=0",
            "attention.hidden_dim=98",
            "attention.num_heads=5",
            "attention.num_levels=3",
            "attention.num_points=0",
            f"{CELLS}.background.kept=[256,768,100000]",
            f"{CELLS}.background.kept=[256,768]",
            f"{CELLS}.background.kept=[0,768,3072]",
            f"{CELLS}.background.refine_dim=0",
            f"{CELLS}.background.grid=[16,16]",
            f"{CELLS}.background.key_grid=[3,16,2]",
            f"{CELLS}.background.key_grid=[16,16]",
            f"{CELLS}.num_layers=0",
            f"{CELLS}.objects.cells=12",
            f"{CELLS}.sight_dim=-4",
            "strides=[8,4,16,32]",
            "strides=[4,8,16]",
            "strides=[2,4,8,16]",
            "roi_scale=0",
            "image_size=[16,208]",
            "image_size=[64,1000000000]",
            "data.image_size=[128,416]",
            "data.roi_scale=3",
        ),
    ),
    "partition": (
        FULL,
        (
            "foreground_classes=[]",
            "foreground_classes=[1,1]",
            "foreground_classes=[0,25]",
            "mask_classes=[]",
            "mask_classes=[9,20]",
            "model.mask_head=null",
            "model.detector=null",
            "loss.occupancy.mask_classes=[9]",
            "loss.occupancy.foreground_classes=[1,2,3]",
        ),
    ),
    "optimizer": (
        FULL,
        (
            "optimizer.lr=-1",
            "optimizer.lr=nan",
            "optimizer.lr=null",
            "optimizer.betas=[0.9]",
            "optimizer.betas=[0.9,1]",
            "optimizer.weight_decay=-0.1",
            "optimizer.matrix_lr=0",
            "+optimizer.lr_factors.backbones=0.1",
            "optimizer.lr_factors.encoder=-1",
            "scheduler.warmup_steps=-5",
            "loss.detection.weights.cls=-1",
            "loss.occupancy.unknown_weight=2",
            "loss.detection.matcher.cost_box=inf",
            "early_matching_share=nan",
        ),
    ),
    "trainer": (
        PRETRAIN,
        (
            "trainer.max_epochs=0",
            "trainer.max_epochs=-1",
            "trainer.gradient_clip_val=-1",
            "trainer.accumulate_grad_batches=0",
            "trainer.limit_train_batches=1.5",
            "trainer.limit_train_batches=0",
            "trainer.check_val_every_n_epoch=0",
            "trainer.precision=12-mixed",
            "trainer.profiler=4097",
            "trainer.accelerator=abacus",
            "trainer.strategy=abacus",
            "trainer.devices=1000000000",
            "trainer.overfit_batches=1.5",
            "+trainer.val_check_interval=0",
            "early_matching_share=1.5",
            "seed=-1",
            "seed=4294967296",
            "seed=1.5",
            "monitor=val/mIoU",
            "loss=full_of_it",
        ),
    ),
    "data": (
        PRETRAIN,
        (
            "trainer.use_distributed_sampler=true",
            "data.street_image_size=[185]",
            "data.num_train=0",
            "data.num_train=1000000000",
            "data.cache_dir=/dev/null",
            "data.num_val=-1",
            "data.seed=-1",
            "data.scale=[2,1]",
            "data.scale=0",
            "data.photometric=-0.1",
            "data.flip=1.5",
            "data.batch_size=0",
            "data.num_workers='3'",
            "data.write_workers=-1",
            "data.objects.ray_stride=0",
            "data.horizontal_fov=170",
            "data.stride=0",
        ),
    ),
}

OTHERS = (
    ("benchmark", "batch_size=0"),
    ("benchmark", "repeats=0"),
    ("benchmark", "warmup=-1"),
    ("benchmark", "samples=0"),
    ("benchmark", "streets=0"),
    ("prepare", "shard=[0,3]"),
    ("prepare", "seed=-1"),
    ("prepare", "data.num_train=0"),
    ("survey", "sheet_width=0"),
    ("survey", "worlds=1000000000"),
    ("survey", "horizontal_fov=0"),
    ("visualize", "width=1.5"),
    ("visualize", "seed=4294967296"),
    ("evaluate", "threads=0"),
    ("evaluate", "batch_size=0"),
    ("evaluate", "batch_size=1000000000"),
    ("predict", "score_threshold=1.5"),
    ("demo", "picture_frame=-1"),
    ("demo", "overrides=x"),
    ("study.plan", "name=none_such"),
)


def malformed_settings() -> list[Malformed]:
    """Every case; the names differ."""
    training = [
        _case("train", kind, *before, setting)
        for kind, (before, settings) in TRAINING.items()
        for setting in settings
    ]
    contradictions = [
        _case("train", "trainer", *FULL, "loss=pretrain"),
        _case("train", "trainer", *PRETRAIN, "callbacks=[early_stopping]", EARLY_STOPPING),
        _case("train", "partition", *FULL, "partition=all_background", "foreground_classes=[1]"),
    ]
    return [*training, *contradictions, *(_case(entry, entry, one) for entry, one in OTHERS)]


EARLY_STOPPING = "callbacks.early_stopping.monitor=val/accuracy"


def _case(command: str, kind: str, *overrides: str) -> Malformed:
    def make(folder: Path) -> list[str]:
        data = [f"data.root={folder}/data"] if command in ("train", "prepare", "visualize") else []
        return [*data, f"hydra.run.dir={folder}/run", *overrides]

    return Malformed(f"{command} {overrides[-1]}", kind, command, make)
