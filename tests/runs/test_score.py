"""Predictions of any method are scored as evaluation scores its own."""

import shutil

from occdetr.data.semantickitti import read_raw_labels, write_raw_labels
from programs import program, read_json, the_error


def given(predictions, streets, folder):
    data = ("data=semantickitti", f"data.root={streets}")
    return (f"predictions={predictions}", *data, f"hydra.run.dir={folder}")


def test_scores_equal_those_of_evaluation(evaluation, streets, tmp_path, capsys):
    assert program("score", *given(evaluation / "predictions", streets, tmp_path / "run")) == 0
    scores = read_json(tmp_path / "run/metrics.json")
    evaluated = read_json(evaluation / "metrics.json")
    for key in ("mIoU", "mIoU_present", "IoU", "precision", "recall", "per_class", "by_distance"):
        assert scores[key] == evaluated[key]
    assert scores["num_frames"] == evaluated["num_frames"] == 3
    assert 0 <= scores["rays"]["RayIoU@1"] <= scores["rays"]["RayIoU@4"] <= 1
    assert "RayIoU@2" in capsys.readouterr().out
    assert (tmp_path / "run/confusion.png").is_file()


def test_the_truth_scores_all(streets, tmp_path):
    truth = tmp_path / "truth/sequences/08"
    shutil.copytree(streets / "sequences/08/voxels", truth / "predictions")
    assert program("score", *given(tmp_path / "truth", streets, tmp_path / "run")) == 0
    scores = read_json(tmp_path / "run/metrics.json")
    assert scores["mIoU_present"] == scores["rays"]["RayIoU"] == 1


def test_what_is_missing_or_wrong_is_named(evaluation, streets, tmp_path, capsys):
    folder = tmp_path / "predictions"
    shutil.copytree(evaluation / "predictions", folder)
    file = folder / "sequences/08/predictions/000005.label"
    raw = read_raw_labels(file).copy()
    raw[0, 0, 0] = 7
    write_raw_labels(file, raw)
    assert program("score", *given(folder, streets, tmp_path / "a")) == 2
    line = the_error(capsys)
    assert str(file) in line
    assert "unknown raw label id 7" in line
    file.unlink()
    assert program("score", *given(folder, streets, tmp_path / "b")) == 2
    assert f"{file}: file is missing, as 1 of 3 predictions" in the_error(capsys)
    assert program("score", *given(folder, streets, tmp_path / "c"), "split=test") == 2
    assert "split=test: has no labels" in the_error(capsys)
    assert program("score", "predictions=null", f"hydra.run.dir={tmp_path}/d") == 2
    assert "predictions is not set" in the_error(capsys)
