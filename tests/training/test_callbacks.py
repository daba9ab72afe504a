"""Pictures of validations show what was predicted there."""

from __future__ import annotations

import lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch.optim.swa_utils import AveragedModel

from model_factory import small_batch, tiny_stage
from occdetr.errors import InputError
from occdetr.models.inference import decode
from occdetr.structures import SceneBatch
from occdetr.training.callbacks import PictureLogger, WeightAveraging, prediction_panel


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


@pytest.mark.parametrize("steps", [30, 300])
def test_an_average_of_weights_soon_forgets_those_before_training(steps: int) -> None:
    weights = torch.nn.Linear(1, 1, bias=False)
    average = AveragedModel(weights, **WeightAveraging(decay=0.999)._kwargs)
    for step in range(steps):
        torch.nn.init.constant_(weights.weight, min(step, 1))
        average.update_parameters(weights)
    assert average.module.weight.item() > 0.999


def test_an_average_of_weights_follows_its_decay() -> None:
    weights = torch.nn.Linear(1, 1, bias=False)
    average = AveragedModel(weights, **WeightAveraging(decay=0.5)._kwargs)
    torch.nn.init.zeros_(weights.weight)
    for _ in range(20):
        average.update_parameters(weights)
    torch.nn.init.ones_(weights.weight)
    average.update_parameters(weights)
    assert average.module.weight.item() == 0.5
    with pytest.raises(InputError, match=r"callbacks.ema.decay=1"):
        WeightAveraging(decay=1.0)
