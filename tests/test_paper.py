"""``experiment=paper`` agrees with docs/paper.md, has the paper's size, and trains."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from model_factory import IMAGE_SIZE, box_target, small_batch
from occdetr.cli import entry as cli
from occdetr.geometry.camera import Camera
from occdetr.geometry.kitti import kitti_camera
from occdetr.training.optimizer import make_optimizer

PAGE = Path(__file__).parents[1] / "docs" / "paper.md"

#: Settings that follow from others, or say nothing of the method.
IMPLIED = {"model_name", "partition_name", "mask_classes"}


@dataclass
class Row:
    """One line of a table: a setting, and its value in the paper and by default."""

    setting: str
    paper: Any
    default: Any


def table(heading: str) -> list[Row]:
    """The rows below a heading of the page."""
    section = PAGE.read_text(encoding="utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = []
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) == 7 and cells[2].startswith("`"):
            setting, paper, default = (re.fullmatch(r"`(.*)`", cell)[1] for cell in cells[2:5])
            rows.append(Row(setting, yaml.safe_load(paper), yaml.safe_load(default)))
    return rows


DIFFERENCES = table("Where the default differs")
FURTHER = table("Where `model=tiny` differs further")


def composed(*overrides: str) -> Any:
    return cli.compose("train", ["stage=full", "data=semantickitti", *overrides])


def value(config: Any, setting: str) -> Any:
    found = OmegaConf.select(config, setting, throw_on_missing=True)
    return OmegaConf.to_container(found) if OmegaConf.is_config(found) else found


@pytest.mark.parametrize("row", DIFFERENCES, ids=lambda row: row.setting)
def test_each_row_is_what_the_configuration_has(row: Row) -> None:
    assert row.paper != row.default
    assert value(composed("experiment=paper"), row.setting) == row.paper
    assert value(composed("model=paper"), row.setting) == row.default


@pytest.mark.parametrize("row", FURTHER, ids=lambda row: row.setting)
def test_each_row_of_the_small_models(row: Row) -> None:
    assert value(composed("experiment=paper"), row.setting) == row.paper
    assert value(composed("model=tiny"), row.setting) == row.default


def leaves(node: Any, path: str = "") -> dict[str, Any]:
    """Every value by its full name; lists are values."""
    if not isinstance(node, dict):
        return {path: node}
    return {
        name: found
        for key, child in node.items()
        for name, found in leaves(child, f"{path}.{key}" if path else key).items()
    }


def test_no_difference_is_left_out() -> None:
    """What differs between the two configurations is in the table, setting by setting."""
    paper, default = (
        leaves(OmegaConf.to_container(composed(choice)))
        for choice in ("experiment=paper", "model=paper")
    )
    absent = object()
    differing = {
        name
        for name in {*paper, *default}
        if paper.get(name, absent) != default.get(name, absent) and name not in IMPLIED
    }
    listed = {row.setting for row in DIFFERENCES}
    assert {n for n in differing if not any(f"{n}.".startswith(f"{s}.") for s in listed)} == set()


def test_the_network_has_the_papers_size() -> None:
    config = composed("experiment=paper", "model.backbone.weights=null")
    with torch.device("meta"):
        model = cli.build(config.model)
    parameters = sum(parameter.numel() for parameter in model.parameters())
    assert parameters == pytest.approx(51.11e6, rel=0.01)
    assert f"{parameters / 1e6:.2f} M (paper: 51.11 M)" in PAGE.read_text(encoding="utf-8")
    assert len(model.encoder.layers) == len(model.detector.layers) == 6
    assert len(model.occupancy_decoder.layers) == 3
    assert len(model.mask_head.layers) == 4
    assert model.occupancy_decoder.background.key_grid is None


def test_both_stages_train_for_50_epochs_with_the_same_weights() -> None:
    both = [cli.compose("train", [f"stage={s}", "experiment=paper"]) for s in ("pretrain", "full")]
    for config in both:
        assert config.trainer.max_epochs == 50
        assert config.optimizer.lr == 1e-4
        assert config.optimizer.weight_decay == 0.01
        assert config.scheduler._target_.endswith("Linear")
        assert config.early_matching_share == 1.0
    assert both[0].loss.detection == both[1].loss.detection
    assert both[0].optimizer == both[1].optimizer


@pytest.mark.parametrize("partition", ["all_foreground", "all_background"])
def test_the_papers_other_modes_build(partition: str) -> None:
    choices = ("experiment=paper", f"partition={partition}", "model.backbone.weights=null")
    with torch.device("meta"):
        model = cli.build(composed(*choices).model)
    assert (model.detector is None) == (partition == "all_background")
    assert (model.mask_head is None) == (partition == "all_foreground")


def one_step(stage: str, batch: Any, overrides: tuple[str, ...] = ()) -> dict[str, torch.Tensor]:
    """The losses of a training step; asserts that it reaches every trained parameter."""
    torch.manual_seed(0)
    config = cli.compose("train", [f"stage={stage}", "experiment=paper", *overrides])
    config.model.backbone.weights = None
    module = cli.build(config.module, model=cli.build(config.model))
    module.train()
    trained = {n: p for n, p in module.model.named_parameters() if p.requires_grad}
    before = {name: parameter.detach().clone() for name, parameter in trained.items()}
    optimizer = make_optimizer(module.model, module.optimizer_settings)
    losses = module.losses(batch)
    torch.stack(list(losses.values())).sum().backward()
    assert [name for name, parameter in trained.items() if parameter.grad is None] == []
    clip = config.trainer.gradient_clip_val
    torch.nn.utils.clip_grad_norm_(module.parameters(), clip, error_if_nonfinite=True)
    optimizer.step()
    assert any(not torch.equal(before[name], parameter) for name, parameter in trained.items())
    return {name: loss.detach() for name, loss in losses.items()}


def test_rates_and_decay_of_the_optimizer() -> None:
    """0.01 for every parameter; sampling offsets and the backbone at a tenth of the rate."""
    config = composed("experiment=paper", "model.backbone.weights=null", *SMALL)
    model = cli.build(config.model)
    groups = make_optimizer(model, cli.build(config.optimizer)).param_groups
    assert {group["weight_decay"] for group in groups} == {0.01}
    assert not any(group["orthogonal"] for group in groups)
    rates = {id(p): group["lr"] for group in groups for p in group["params"]}
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            slow = name.startswith("backbone.") or "sampling_offsets" in name
            assert rates[id(parameter)] == pytest.approx(1e-5 if slow else 1e-4), name


DETECTION = {"cls", "box2d", "giou2d", "box3d", "giou3d"}
PAPER_TERMS = {
    *DETECTION,
    *(f"aux_{name}" for name in DETECTION),
    "proposal_cls",  # the positions are preset, so no box is learnt there
}
OCCUPANCY_TERMS = {
    *("foreground_dice", "background_bce", "mask_focal", "mask_dice"),
    *("aux_mask_focal", "aux_mask_dice"),
}

#: The paper's network with small parts.
SMALL = (
    *(f"image_size={list(IMAGE_SIZE)}", "attention.hidden_dim=64", "attention.feedforward_dim=64"),
    *("model.backbone.depth=18", "model.encoder.in_channels=[128,256,512]"),
    *("model.encoder.num_layers=1", "model.detector.num_layers=2"),
    *("model.detector.selection.num_queries=30", "model.slots.num_slots=4"),
    "model.occupancy_decoder.background.kept=[128,256,512]",
)


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_a_small_version_makes_a_step(stage: str) -> None:
    batch = small_batch(1)
    batch.targets = [box_target(strides=(8, 16, 32, 64), roi_scale=4.0)]
    losses = one_step(stage, batch, SMALL)
    expected = PAPER_TERMS | (OCCUPANCY_TERMS if stage == "full" else set())
    assert set(losses) == expected
    assert all(torch.isfinite(loss) for loss in losses.values())


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_the_whole_network_makes_a_step(stage: str) -> None:
    batch, camera = small_batch(1), kitti_camera((370, 1220))
    matrices = (camera.projection, camera.lidar_to_camera)
    batch.camera = Camera(*(torch.tensor(m).float()[None] for m in matrices), camera.image_size)
    batch.images = torch.randn(1, 3, 370, 1220)
    losses = one_step(stage, batch)
    assert all(torch.isfinite(loss) for loss in losses.values())
