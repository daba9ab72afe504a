"""Pictures of validations show what was predicted there, in every logger that takes pictures."""

from __future__ import annotations

from typing import Any

import lightning
import numpy as np
import pytest
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from model_factory import small_batch, tiny_stage
from occdetr.models.inference import decode
from occdetr.structures import SceneBatch
from occdetr.training import pictures
from occdetr.training.pictures import PictureLogger, log_picture, picture_loggers, prediction_panel


@pytest.mark.parametrize("stage", ["full", "pretrain"])
def test_pictures_take_one_prediction(stage: str, tmp_path, monkeypatch) -> None:
    """Of validation itself, if it runs the whole network."""
    module, batch = tiny_stage(stage).eval(), small_batch(1)
    logger, pictures, predicted = TensorBoardLogger(tmp_path), [], []
    monkeypatch.setattr(logger.experiment, "add_image", lambda *a, **_: pictures.append(a[:2]))
    predict = module.model.predict

    def record(batch: SceneBatch):
        predicted.append(predict(batch))
        return predicted[-1]

    monkeypatch.setattr(module.model, "predict", record)
    outputs = module.validation_step(batch, 0)
    trainer = lightning.Trainer(logger=logger, accelerator="cpu", default_root_dir=tmp_path)
    PictureLogger(num_frames=1).on_validation_batch_end(trainer, module, outputs, batch, 0)
    assert len(predicted) == 1
    [(name, picture)] = pictures
    assert name == "val_pictures/00_000000"
    shown = decode(module.model, *predicted[0])[0]
    np.testing.assert_array_equal(picture, prediction_panel(batch, 0, shown))


class OtherLogger(CSVLogger):
    """Takes pictures as the logger of Weights & Biases does."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.taken: list[Any] = []

    def log_image(self, key: str, images: list[Any], step: int | None = None) -> None:
        self.taken.append((key, images, step))


def test_pictures_go_to_the_loggers_that_take_them(tmp_path) -> None:
    other, table = OtherLogger(tmp_path / "other"), CSVLogger(tmp_path / "table")
    loggers: list[Logger] = [table, other]
    trainer = lightning.Trainer(logger=loggers, accelerator="cpu", default_root_dir=tmp_path)
    assert picture_loggers(trainer) == [other]
    picture = np.zeros((4, 6, 3), dtype=np.uint8)
    log_picture(picture_loggers(trainer), "val_pictures/a", picture, 7)
    [(key, [image], step)] = other.taken
    assert (key, step) == ("val_pictures/a", 7)
    assert image is picture


@pytest.mark.parametrize("logger", [False, "csv"])
def test_nothing_is_drawn_for_nobody(logger, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(pictures, "decode", None)  # would be called
    chosen: Any = CSVLogger(tmp_path) if logger else False
    trainer = lightning.Trainer(logger=chosen, accelerator="cpu", default_root_dir=tmp_path)
    PictureLogger().on_validation_batch_end(trainer, None, None, small_batch(1), 0)
