"""Prediction for pictures: its files, and its equality with evaluation."""

import numpy as np

from occdetr.data.semantickitti import read_raw_labels
from programs import program, read_json, the_error


def test_prediction_needs_no_labels(varied_checkpoint, streets, tmp_path):
    sequence = streets / "sequences/08"
    given = (f"images={sequence / 'image_2/*.png'}", f"calib={sequence / 'calib.txt'}")
    folder = f"hydra.run.dir={tmp_path}"
    assert program("predict", f"checkpoint={varied_checkpoint}", *given, folder, "device=cpu") == 0
    entries = read_json(tmp_path / "predictions.json")["images"]
    assert [entry["label"] for entry in entries] == ["000000.label", "000005.label", "000010.label"]
    assert all(entry["objects"] for entry in entries)
    for entry in entries:
        assert read_raw_labels(tmp_path / entry["label"]).any()
        assert (tmp_path / entry["picture"]).stat().st_size > 10_000
        left, top, right, bottom = np.array([o["box_xyxy"] for o in entry["objects"]]).T
        assert (right > left).all()
        assert (bottom > top).all()


def test_prediction_equals_evaluation(varied_checkpoint, streets, tmp_path):
    sequence, given = streets / "sequences/08", f"checkpoint={varied_checkpoint}"
    program("evaluate", given, "save_predictions=true", f"hydra.run.dir={tmp_path / 'a'}")
    image = f"images={sequence / 'image_2/000005.png'}"
    calib = f"calib={sequence / 'calib.txt'}"
    program("predict", given, image, calib, f"hydra.run.dir={tmp_path / 'b'}")
    evaluated = tmp_path / "a/predictions/sequences/08/predictions/000005.label"
    np.testing.assert_array_equal(
        read_raw_labels(evaluated), read_raw_labels(tmp_path / "b/000005.label")
    )


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
