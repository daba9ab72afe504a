"""Outputs and weights that are not finite are refused in one line."""

import math

import pytest
import torch

from model_factory import small_batch, tiny_model
from occdetr.errors import InputError
from occdetr.evaluation.evaluator import SceneEvaluator
from occdetr.evaluation.finite import FiniteOutputs
from occdetr.models.inference import predict
from programs import program, the_error

#: An output, and a weight that only it depends on.
WEIGHTS = {
    "mask_logits": "mask_head.mask_embed.4.bias",
    "foreground_logits": "occupancy_decoder.foreground_head.2.bias",
    "pred_boxes3d": "detector.box3d_heads.2.4.bias",
}


@pytest.mark.parametrize("output", WEIGHTS)
def test_predictions_and_figures_of_outputs_that_are_not_finite_are_refused(output) -> None:
    model, batch = tiny_model().eval(), small_batch(2)
    with torch.no_grad():
        model.get_parameter(WEIGHTS[output]).fill_(math.nan)
    evaluator = SceneEvaluator(model.image_size, detects=True)
    for measure in (lambda: predict(model, batch), lambda: evaluator.update(model, batch)):
        with pytest.raises(InputError, match="00/000000, 00/000001: the network's output is not"):
            measure()


def test_ranks_refuse_together_what_one_of_them_has_counted() -> None:
    metric = FiniteOutputs()
    metric.count += 2  # as after the sum over the ranks
    with pytest.raises(InputError, match="2 frames: the network's output is not finite"):
        metric.compute()
    metric.reset()
    metric.compute()


@pytest.mark.parametrize("entry", ["evaluate", "predict"])
def test_a_checkpoint_with_weights_that_are_not_finite_is_named(
    entry, checkpoint, streets, tmp_path, capsys
) -> None:
    raw = torch.load(checkpoint, weights_only=True)
    raw["state_dict"]["model.encoder.level_embed"][1, 0] = math.inf
    torch.save(raw, tmp_path / "diverged.ckpt")
    sequence = streets / "sequences/08"
    pictures = (f"images={sequence}/image_2", f"calib={sequence}/calib.txt")
    given = (f"checkpoint={tmp_path}/diverged.ckpt", f"hydra.run.dir={tmp_path}/run")
    assert program(entry, *given, *(pictures if entry == "predict" else ())) == 2
    line = the_error(capsys)
    assert f"checkpoint={tmp_path}/diverged.ckpt: encoder.level_embed is not finite" in line
