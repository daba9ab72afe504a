"""Models and batches for the tests, made from the shipped configuration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch.utils.data import DataLoader

from occdetr.data.early_matching import match_rois
from occdetr.geometry.camera import Camera
from occdetr.geometry.rois import preset_rois
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import SceneBatch, SceneTarget, empty_target

CONF = Path(__file__).parents[1] / "conf"
IMAGE_SIZE = (64, 208)
#: ``model=tiny`` with a quarter of its pixels and an eighth of its background voxels.
SMALL_IMAGE = f"image_size={list(IMAGE_SIZE)}"
SMALL_GRID = "model.occupancy_decoder.background.kept=[256,768,3072]"


def tiny_config(
    partition: str = "mixed", stage: str = "full", overrides: Sequence[str] = ()
) -> Any:
    """The composed training configuration of ``model=tiny``, made smaller."""
    choices = [f"partition={partition}", f"stage={stage}", SMALL_IMAGE]
    if partition != "all_foreground":  # which has no background voxels
        choices.append(SMALL_GRID)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", overrides=[*choices, *overrides])


def tiny_model(partition: str = "mixed", overrides: Sequence[str] = ()) -> OccupancyDETR:
    torch.manual_seed(0)
    return instantiate(tiny_config(partition, overrides=overrides).model)


def tiny_stage(stage: str, partition: str = "mixed", overrides: Sequence[str] = ()) -> Any:
    """A stage's LightningModule with its model."""
    torch.manual_seed(0)
    config = tiny_config(partition, stage, overrides)
    return instantiate(config.module, model=instantiate(config.model))


def on_backbone_alone(module: Any) -> Any:
    """The same stage with one cheap loss, ``mean``, that only the backbone changes."""

    def losses(batch: SceneBatch) -> dict[str, torch.Tensor]:
        return {"mean": torch.stack([m.mean() for m in module.model.backbone(batch.images)]).sum()}

    module.losses = losses
    return module


def fit_batches(
    module: Any,
    batches: Sequence[SceneBatch],
    folder: Path,
    resume: Path | None = None,
    **given: Any,
) -> lightning.Trainer:
    """Train on these batches, without validation and files; ``given`` are the Trainer's."""
    keywords = {"max_epochs": 1, "accelerator": "cpu", "logger": False} | given
    trainer = lightning.Trainer(
        **{"enable_checkpointing": False, "enable_progress_bar": False} | keywords,
        enable_model_summary=False,
        use_distributed_sampler=False,
        default_root_dir=folder,
    )
    loader = DataLoader(list(batches), batch_size=None)
    trainer.fit(module, loader, ckpt_path=resume, weights_only=True)
    return trainer


def camera(batch: int) -> Camera:
    """KITTI's camera at ``IMAGE_SIZE``."""
    projection = torch.tensor([[120.0, 0, 102, 7.5], [0, 122.5, 31.5, 0], [0, 0, 1, 0.003]])
    lidar_to_camera = torch.tensor(
        [[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]
    )
    return Camera(
        projection.expand(batch, 3, 4).clone(),
        lidar_to_camera.expand(batch, 4, 4).clone(),
        IMAGE_SIZE,
    )


def box_target(strides: Sequence[int] = (4, 8, 16, 32), roi_scale: float = 2.0) -> SceneTarget:
    """A car 12 m ahead and a pole 9 m ahead."""
    boxes = torch.tensor([[0.45, 0.65, 0.15, 0.3], [0.7, 0.4, 0.02, 0.5]])
    centers = torch.tensor([[12.0, 1.0, -1.0], [9.0, -3.0, 0.0]])
    sizes = torch.tensor([[4.0, 1.8, 1.6], [0.2, 0.2, 3.0]])
    lower = ((centers - sizes / 2 - torch.tensor([0.0, -25.6, -2.0])) / 0.2).round().int()
    upper = ((centers + sizes / 2 - torch.tensor([0.0, -25.6, -2.0])) / 0.2).round().int()
    voxels = [
        torch.cartesian_prod(*[torch.arange(int(a), int(b)) for a, b in zip(lo, hi, strict=True)])
        for lo, hi in zip(lower, upper, strict=True)
    ]
    owner = torch.cat([torch.full((len(v),), i) for i, v in enumerate(voxels)])
    rois = preset_rois(IMAGE_SIZE, strides, roi_scale)
    camera_centers = torch.stack([-centers[:, 1], -centers[:, 2] - 0.08, centers[:, 0] - 0.27], -1)
    return SceneTarget(
        classes=torch.tensor([1, 18]),
        boxes_cxcywh=boxes,
        boxes3d_camera=torch.cat([camera_centers, sizes[:, [1, 2, 0]]], -1),
        boxes3d_grid=torch.cat([centers, sizes], -1),
        voxels=torch.cat(voxels).to(torch.int16),
        voxel_object=owner,
        visible_fraction=torch.ones(2),
        roi_indices=torch.from_numpy(match_rois(boxes.numpy(), rois)),
    )


def small_batch(batch: int, objects: bool = True, seed: int = 0) -> SceneBatch:
    """Random images, labels with a road and unknown voxels and, if asked, two objects."""
    generator = torch.Generator().manual_seed(seed)
    labels = torch.zeros(batch, 256, 256, 32, dtype=torch.uint8)
    labels[:, :, 100:150, 1] = 9
    labels[:, :, 160:200, 1:12] = 15
    labels[:, :, :, 28:] = 255
    targets = [box_target() if objects else empty_target() for _ in range(batch)]
    for frame, target in enumerate(targets):
        x, y, z = target.voxels.long().unbind(1)
        labels[frame, x, y, z] = target.classes[target.voxel_object].to(torch.uint8)
    return SceneBatch(
        images=torch.randn(batch, 3, *IMAGE_SIZE, generator=generator),
        camera=camera(batch),
        frame_indices=torch.arange(batch),
        frame_ids=[f"00/{i:06d}" for i in range(batch)],
        labels=labels,
        targets=targets,
    )
