"""Prediction for pictures: its files, and its equality with evaluation."""

import shutil

import numpy as np

from occdetr.data.semantickitti import read_raw_labels
from programs import program, read_json, the_error


def test_prediction_without_labels_equals_evaluation(
    varied_checkpoint, evaluation, streets, tmp_path
):
    source, goal = streets / "sequences/08", tmp_path / "pictures"  # and no labels
    goal.mkdir()
    for name in ("calib.txt", "image_2/000000.png", "image_2/000010.png"):
        shutil.copy(source / name, goal)
    given = (f"images={goal}", f"calib={goal / 'calib.txt'}", "device=cpu")
    made = tmp_path / "run"
    assert (
        program("predict", f"checkpoint={varied_checkpoint}", *given, f"hydra.run.dir={made}") == 0
    )
    entries = read_json(made / "predictions.json")["images"]
    assert [entry["label"] for entry in entries] == ["000000.label", "000010.label"]
    evaluated = evaluation / "predictions/sequences/08/predictions"
    for entry in entries:
        labels = read_raw_labels(made / entry["label"])
        np.testing.assert_array_equal(labels, read_raw_labels(evaluated / entry["label"]))
        assert labels.any()
        assert (made / entry["picture"]).stat().st_size > 10_000
        assert entry["objects"]
        left, top, right, bottom = np.array([o["box_xyxy"] for o in entry["objects"]]).T
        assert (right > left).all()
        assert (bottom > top).all()


def test_missing_input_is_named(checkpoint, streets, tmp_path, capsys):
    sequence, folder = streets / "sequences/08", f"hydra.run.dir={tmp_path}/run"
    images, calib = sequence / "image_2", sequence / "calib.txt"
    given = (f"checkpoint={checkpoint}", folder)
    assert program("predict", *given, f"images={tmp_path}/*.png", f"calib={calib}") == 2
    assert f"{tmp_path}/*.png" in the_error(capsys)
    assert program("predict", *given, f"images={images}", f"calib={tmp_path}/calib.txt") == 2
    assert "calib.txt: calibration file is missing" in the_error(capsys)
    assert program("predict", *given, f"images={images}", "calib=null") == 2
    assert "calib is not set" in the_error(capsys)
