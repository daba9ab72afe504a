"""Pictures of validations show what was predicted there."""

from __future__ import annotations

import lightning
import numpy as np
import pytest
from lightning.pytorch.loggers import TensorBoardLogger

from model_factory import small_batch, tiny_stage
from occdetr.models.inference import decode
from occdetr.structures import SceneBatch
from occdetr.training.callbacks import PictureLogger, prediction_panel


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
    assert name == "val/00_000000"
    shown = decode(module.model, *predicted[0])[0]
    np.testing.assert_array_equal(picture, prediction_panel(batch, 0, shown))
