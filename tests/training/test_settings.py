"""Settings that are checked before a training."""

from model_factory import tiny_model
from occdetr.training.settings import classes_without_a_part, explain_trainer


def test_classes_that_are_never_predicted_are_named():
    assert classes_without_a_part(tiny_model()) is None
    assert classes_without_a_part(tiny_model("all_background")) is None
    choice = ["foreground_classes=[1,2]", "mask_classes=[9,10,11,12,13,14,15,16,18,19]"]
    line = classes_without_a_part(tiny_model(overrides=choice))
    assert line is not None
    named = line.partition(":")[0].split(", ")
    assert named == ["motorcycle", "truck", "other-vehicle", *RIDERS, "terrain"]


RIDERS = ("person", "bicyclist", "motorcyclist")


def test_what_lightning_refuses_names_the_setting():
    line = explain_trainer({"max_time": "abc", "devices": 1}, "abc is not in the\nformat DD:HH")
    assert line == "trainer.max_time=abc: abc is not in the format DD:HH: change that setting"
