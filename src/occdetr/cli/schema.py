"""Types of the settings, as structured configurations.

``check_types`` compares a composed configuration with them. They are not in the defaults lists of
``conf``, because a structured node is closed: a keyword of the Trainer, or of another class by
``_target_``, could not be added with ``+``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ValidationError

from occdetr.errors import InputError

Number = float | None
Whole = int | None
Text = str | None
Flag = bool | None
Numbers = list[float] | None
Wholes = list[int] | None


@dataclass
class Trainer:
    """Keywords of lightning.Trainer that have one type; the others are checked by Lightning."""

    accelerator: Text = None
    num_nodes: Whole = None
    max_epochs: Whole = None
    min_epochs: Whole = None
    max_steps: Whole = None
    min_steps: Whole = None
    gradient_clip_val: Number = None
    accumulate_grad_batches: Whole = None
    check_val_every_n_epoch: Whole = None
    num_sanity_val_steps: Whole = None
    log_every_n_steps: Whole = None
    limit_train_batches: Number = None
    limit_val_batches: Number = None
    limit_test_batches: Number = None
    overfit_batches: Number = None
    enable_progress_bar: Flag = None
    enable_model_summary: Flag = None
    use_distributed_sampler: Flag = None


@dataclass
class Data:
    """Keywords of the data modules."""

    root: Text = None
    stride: Whole = None
    batch_size: Whole = None
    num_workers: Whole = None
    pin_memory: Flag = None
    flip: Number = None
    photometric: Number = None
    scale: Numbers = None
    cache_dir: Text = None
    shuffle_seed: Whole = None
    train_sequences: list[Any] | None = None
    val_sequences: list[Any] | None = None
    test_sequences: list[Any] | None = None
    num_train: Whole = None
    num_val: Whole = None
    seed: Whole = None
    street_image_size: Wholes = None
    horizontal_fov: Number = None
    scans_per_world: Whole = None
    write_workers: Whole = None


@dataclass
class Optimizer:
    """Keywords of ``OptimizerSettings``."""

    lr: Number = None
    weight_decay: Number = None
    betas: Numbers = None
    lr_factors: dict[str, float] = field(default_factory=dict)
    matrix_lr: Number = None


@dataclass
class Scheduler:
    """Keywords of the schedules."""

    warmup_steps: Whole = None


@dataclass
class Settings:
    """The settings of all entry points that have one type."""

    seed: Whole = None
    outputs: Text = None
    init_from: Text = None
    resume: Text = None
    checkpoint: Text = None
    start: Text = None
    epochs: dict[str, int] = field(default_factory=dict)
    batch: dict[str, int] = field(default_factory=dict)
    check_every: dict[str, int] = field(default_factory=dict)
    strides: Wholes = None
    hidden_dim: Whole = None
    num_heads: Whole = None
    num_levels: Whole = None
    num_points: Whole = None
    feedforward_dim: Whole = None
    roi_scale: Number = None
    early_matching_share: Number = None
    upper_bound: Flag = None
    diagnose: Flag = None
    save_predictions: Flag = None
    exchange_images: Flag = None
    rebuild: Flag = None
    backward: Flag = None
    photograph: Flag = None
    split: Text = None
    device: Text = None
    batch_size: Whole = None
    threads: Whole = None
    workers: Whole = None
    worlds: Whole = None
    width: Whole = None
    sheet: Whole = None
    sheet_width: Whole = None
    repeats: Whole = None
    warmup: Whole = None
    samples: Whole = None
    score_threshold: Number = None
    trainer: Trainer = field(default_factory=Trainer)
    data: Data = field(default_factory=Data)
    optimizer: Optimizer = field(default_factory=Optimizer)
    scheduler: Scheduler = field(default_factory=Scheduler)


def check_types(config: DictConfig) -> None:
    """Raises ``InputError`` for a setting of another type than ``Settings`` has, and for an
    ``image_size`` that is not a size. Settings that ``Settings`` does not have may be anything."""
    types = OmegaConf.structured(Settings())
    for node in (types, *(value for value in types.values() if isinstance(value, DictConfig))):
        OmegaConf.set_struct(node, False)
    try:
        OmegaConf.merge(types, config)
    except ValidationError as error:
        raise InputError(f"{error.full_key}: {str(error).splitlines()[0]}") from error
    size = OmegaConf.select(config, "image_size")
    if size is not None and not _is_size(size):
        raise InputError(f"image_size={size}: must be [height, width] in pixels")


def _is_size(size: Any) -> bool:
    whole = OmegaConf.is_list(size) and all(type(n) is int and n > 0 for n in size)
    return whole and len(size) == 2
