"""Every term of the losses has a group, and the groups add up."""

from __future__ import annotations

import pytest
import torch

from occdetr.losses import detection, occupancy
from occdetr.losses.groups import grouped_losses, loss_group


def test_every_term_of_the_package_has_a_group() -> None:
    terms = [*detection.TERMS, *occupancy.TERMS]
    terms += [f"{prefix}_{name}" for prefix in ("aux", "proposal") for name in detection.TERMS]
    groups = {term: loss_group(term) for term in terms}
    names = {"detection", "auxiliary", "proposal", "occupancy", "mask"}
    assert set(groups.values()) == names
    assert groups["scene_dice"] == "mask"
    assert groups["foreground_bce"] == groups["geo_scal"] == "occupancy"
    assert groups["proposal_cls"] == "proposal"
    assert loss_group("entropy") == "other"


def test_the_groups_add_up_to_the_loss() -> None:
    terms = ["cls", "aux_cls", "aux_box2d", "mask_dice", "own"]
    values = torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0])
    figures = grouped_losses(terms, values)
    assert figures["loss_auxiliary/aux_box2d"] == 4
    assert figures["loss/auxiliary"] == 6
    sums = [value for name, value in figures.items() if name.startswith("loss/")]
    assert sum(sums) == pytest.approx(31)
    assert len(figures) == len(terms) + len(sums)
