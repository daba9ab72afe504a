"""A network built in Python is checked as one built by Hydra."""

import pytest

from model_factory import tiny_model
from occdetr.errors import InputError
from occdetr.models.encoder import DeformableEncoder
from occdetr.models.layers import AttentionSize
from occdetr.models.occdetr import OccupancyDETR
from occdetr.models.slots import SlotSelection
from occdetr.training.optimizer import OptimizerSettings, check_parts

PARTS = ("backbone", "encoder", "detector", "slots", "occupancy_decoder", "mask_head", "fusion")


@pytest.fixture(scope="module")
def model():
    return tiny_model()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: {"slots": SlotSelection(num_slots=101)}, "num_slots=101: more than the 100"),
        (lambda m: {"mask_head": None}, "model.mask_head=null: "),
        (lambda m: {"detector": None}, "model.detector=null: foreground_classes=.*need"),
        (lambda m: {"foreground_classes": [1, 2]}, "model.detector.classes=.*must be foreground"),
        (lambda m: {"foreground_classes": [1, 1]}, "foreground_classes=.*: give each id once"),
        (lambda m: {"image_size": (128, 208)}, "model.image_size=.*: the preset ROIs are of"),
        (
            lambda m: {"encoder": _encoder([64, 128])},
            "encoder.in_channels=.*the backbone has",
        ),
    ],
)
def test_parts_that_do_not_fit_each_other_are_refused(model, change, message):
    given = {name: getattr(model, name) for name in PARTS}
    given |= {"image_size": model.image_size, "foreground_classes": model.detector.classes}
    OccupancyDETR(**given)
    with pytest.raises(InputError, match=message):
        OccupancyDETR(**(given | change(model)))


def _encoder(in_channels):
    return DeformableEncoder(in_channels, AttentionSize(32, 4, 4, 1, 8), num_layers=1)


def test_a_rate_is_of_a_part_of_the_network(model):
    check_parts(model, OptimizerSettings(lr_factors={"backbone": 0.1, "mask_head": 0}))
    with pytest.raises(InputError, match=r"lr_factors\.neck: no such part.*choose one of backbone"):
        check_parts(model, OptimizerSettings(lr_factors={"neck": 0.1}))
    with pytest.raises(InputError, match=r"adamw_parts=neck: no such part.*choose one of backbone"):
        check_parts(model, OptimizerSettings(adamw_parts=["neck"]))
    background = tiny_model("all_background")  # its settings have the rate of a detector too
    check_parts(background, OptimizerSettings(lr_factors={"detector": 0.1}))
