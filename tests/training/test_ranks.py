"""Two ranks train like one process that has the frames of both."""

from __future__ import annotations

import math
from datetime import timedelta
from pathlib import Path

import pytest
import torch
from lightning.fabric.plugins.environments import LightningEnvironment
from lightning.pytorch.strategies import DDPStrategy
from torch import distributed as dist
from torch import nn
from torch.multiprocessing.spawn import spawn
from torch.nn.parallel import DistributedDataParallel

from model_factory import box_target, fit_batches, small_batch, tiny_stage
from occdetr.errors import InputError
from occdetr.geometry.camera import Camera
from occdetr.structures import SceneBatch, SceneTarget, empty_target
from occdetr.training.nonfinite import FILE, KEY

#: Stage, its settings, and the objects of each of two frames.
CASES = (
    ("pretrain", (), (5, 14)),
    ("pretrain", ("early_matching_share=0",), (5, 0)),
    ("full", (), (5, 14)),
    ("full", ("model.mask_head.auxiliary=true",), (0, 5)),
)


class Losses(nn.Module):
    """The sum of a stage's losses, as DDP wraps a training step."""

    def __init__(self, module) -> None:
        super().__init__()
        self.module = module

    def forward(self, batch: SceneBatch) -> torch.Tensor:
        return torch.stack(list(self.module.losses(batch).values())).sum()


def stage_of(stage: str, settings: tuple[str, ...]) -> Losses:
    """A stage with random weights in every layer, whose batch norms do not depend on the batch."""
    few = "model.occupancy_decoder.background.kept=[64,128,512]"
    module = tiny_stage(stage, overrides=[few, *settings])
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():  # layers that start at zero would hide those before them
        for parameter in module.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    module.train()
    module.model.backbone.freeze_statistics()
    return Losses(module)


def target_with(count: int) -> SceneTarget:
    """Objects at random places of the image, so large in space that every box meets them."""
    if count == 0:
        return empty_target()
    generator, car = torch.Generator().manual_seed(count), box_target()
    axes = [torch.arange(0, side, step) for side, step in ((256, 3), (256, 3), (32, 2))]
    voxels = torch.cartesian_prod(*axes).to(torch.int16)
    return SceneTarget(
        classes=car.classes[:1].repeat(count),
        boxes_cxcywh=0.2 + 0.6 * torch.rand(count, 4, generator=generator),
        boxes3d_camera=car.boxes3d_camera[:1] + torch.rand(count, 6, generator=generator),
        boxes3d_grid=car.boxes3d_grid[:1].repeat(count, 1),
        voxels=voxels,
        voxel_object=torch.arange(len(voxels)) % count,
        visible_fraction=torch.ones(count),
        roi_indices=torch.arange(count),
    )


def batch_with(counts: tuple[int, ...]) -> SceneBatch:
    """Frames with so many objects each, and different numbers of known and occupied voxels."""
    batch = small_batch(len(counts))
    batch.targets = [target_with(count) for count in counts]
    batch.labels[0, 100:] = 255
    batch.labels[1:, :, 60:90, 3:20] = 13
    return batch


def frame_of(batch: SceneBatch, index: int) -> SceneBatch:
    own = slice(index, index + 1)
    matrices = batch.camera.projection[own], batch.camera.lidar_to_camera[own]
    return SceneBatch(
        batch.images[own],
        Camera(*matrices, batch.camera.image_size),
        batch.frame_indices[own],
        batch.frame_ids[own],
        batch.labels[own],
        batch.targets[own],
    )


def gradients(losses: nn.Module, batch: SceneBatch) -> dict[str, torch.Tensor]:
    losses(batch).backward()
    return {n: p.grad.clone() for n, p in losses.named_parameters() if p.requires_grad}


def run_rank(rank: int, folder: Path) -> list[dict[str, torch.Tensor]]:
    """What one of two ranks does: returns its gradients of every case, after a training that must
    stop, since the second frame has a pixel that is not a number."""
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("LOCAL_RANK", rank), ("NODE_RANK", 0), ("WORLD_SIZE", 2)):
            patch.setenv(name, str(value))
        dist.init_process_group(
            "gloo",
            init_method=f"file://{folder}/store",
            rank=rank,
            world_size=2,
            timeout=timedelta(minutes=5),  # a deadlock fails; a busy machine starts late
        )
        try:
            stop_training(rank, folder)
            return [
                gradients(
                    DistributedDataParallel(stage_of(stage, settings)),
                    frame_of(batch_with(counts), rank),
                )
                for stage, settings, counts in CASES
            ]
        finally:
            dist.destroy_process_group()


def stop_training(rank: int, folder: Path) -> None:
    """Leaves the message in ``stopped<rank>.txt``."""
    batch = frame_of(small_batch(2), rank)
    if rank == 1:
        batch.images[0, 0, 0, 0] = math.nan
    strategy = DDPStrategy(cluster_environment=LightningEnvironment())
    with pytest.raises(InputError) as caught:
        fit_batches(tiny_stage("pretrain"), [batch], folder, strategy=strategy, devices=2)
    (folder / f"stopped{rank}.txt").write_text(str(caught.value))


def second_rank(_: int, folder: Path) -> None:
    run_rank(1, folder)


@pytest.mark.filterwarnings("ignore")
def test_two_ranks_train_like_one_process_and_stop_together(tmp_path) -> None:
    other = spawn(second_rank, (tmp_path,), nprocs=1, join=False)
    found = run_rank(0, tmp_path)
    other.join()
    for (stage, settings, counts), two in zip(CASES, found, strict=True):
        one = gradients(stage_of(stage, settings), batch_with(counts))
        assert one.keys() == {name.removeprefix("module.") for name in two}
        difference = sum((two[f"module.{n}"] - g).square().sum() for n, g in one.items()).sqrt()
        norm = sum(g.square().sum() for g in one.values()).sqrt()
        assert difference < 3e-5 * norm, (stage, counts)
    lines = [(tmp_path / f"stopped{rank}.txt").read_text() for rank in range(2)]
    assert lines[0] == lines[1]
    assert "step 1, epoch 0: loss cls is nan in the frames 00/000001: " in lines[0]
    batches = torch.load(tmp_path / FILE, weights_only=True)[KEY]["batches"]
    seen = [(batch["rank"], batch["frame_ids"]) for batch in batches]
    assert seen == [(0, ["00/000000"]), (1, ["00/000001"])]
