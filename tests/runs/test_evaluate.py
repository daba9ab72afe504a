"""Evaluation of checkpoints: its figures against references, its files and its data."""

import cv2
import numpy as np
import pytest

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.data.frames import find_frames
from occdetr.data.semantickitti import read_labels
from occdetr.drawing.boxes import class_legend
from occdetr.drawing.confusion import draw_confusion
from occdetr.evaluate import evaluation_data
from occdetr.evaluation.recall import BANDS
from occdetr.evaluation.substitution import PREDICTION_PARTS
from occdetr.evaluation.upper_bound import LIMITS
from occdetr.files import read_image
from occdetr.training.callbacks import SHEET_WIDTH
from occdetr.training.checkpoint import read_checkpoint
from programs import STREETS, newest, program, read_json, subprogram, the_error
from reference_completion import evaluate_folders


def number_of_objects(metrics):
    return sum(b["objects"] for bands in metrics["objects_found"].values() for b in bands.values())


def test_evaluation_equals_the_reference(evaluation, streets):
    metrics = read_json(evaluation / "metrics.json")
    assert metrics["num_frames"] == 3
    assert 0 < metrics["mIoU"] < metrics["mIoU_present"]
    assert set(metrics) >= {"mAP", "AP50", "recall3d_25"}
    expected = evaluate_folders(streets, evaluation / "predictions", ["08"])
    for key in ("mIoU", "IoU", "precision", "recall"):
        assert metrics[key] == expected[key]
    assert [metrics["per_class"][name] for name in CLASS_NAMES[1:]] == expected["classes"]


def test_the_first_frames_are_drawn(evaluation):
    picture = read_image(evaluation / "predictions.jpg")
    legend = class_legend(SHEET_WIDTH)
    assert picture.shape[1] == SHEET_WIDTH
    rows = np.split(picture[: len(picture) - len(legend)], 2)
    assert len(rows[0]) > 100
    for row in rows:
        image, truth, prediction = row[:, :512], row[:, 516:896], row[:, 900:]
        assert min(part.std() for part in (image, truth, prediction)) > 5
    assert "predictions.jpg" in (evaluation / "output.txt").read_text()


def test_two_ranks_equal_one(varied_checkpoint, evaluation, tmp_path):
    """Of three frames, so that the ranks have unequal shares."""
    given = ("save_predictions=true", "diagnose=true", "trainer=cpu")
    ranks = ("trainer.devices=2", "trainer.strategy=ddp", f"hydra.run.dir={tmp_path}")
    done = subprogram("evaluate", f"checkpoint={varied_checkpoint}", *given, *ranks)
    assert done.returncode == 0, done.stderr
    for name in ("metrics.json", "diagnosis.json"):
        assert read_json(tmp_path / name) == read_json(evaluation / name)
    assert predictions(tmp_path) == predictions(evaluation)


def predictions(folder):
    """The content of each prediction of an evaluation."""
    files = (folder / "predictions").rglob("*.label")
    return {file.relative_to(folder): file.read_bytes() for file in files}


def test_part_of_a_split_is_called_so(varied_checkpoint, tmp_path, capsys):
    given = (f"checkpoint={varied_checkpoint}", "trainer=cpu")
    limited = ("trainer.limit_test_batches=1", f"hydra.run.dir={tmp_path / 'one'}")
    assert program("evaluate", *given, *limited) == 0
    assert "note: only 1 of 3 frames" in capsys.readouterr().out
    none = ("trainer.limit_test_batches=0", f"hydra.run.dir={tmp_path / 'none'}")
    assert program("evaluate", *given, *none) == 2
    assert "trainer.limit_test_batches=0" in the_error(capsys)


def test_partial_data_are_asked_for_in_an_evaluation_too(varied_checkpoint):
    trained = read_checkpoint(varied_checkpoint).config
    trained["data"]["allow_partial"] = True
    for given, allowed in (([], False), (["data.allow_partial=true"], True)):
        config = cli.compose("evaluate", [f"checkpoint={varied_checkpoint}", *given])
        assert evaluation_data(config, trained).folder.allow_partial == allowed


def test_exchanged_images_on_other_data(varied_checkpoint, evaluation, streets, tmp_path, capsys):
    """The data that are given replace those of the checkpoint, but here are the same."""
    data = ("data=synthetic", *STREETS, f"data.root={streets}")
    exchanged = ("exchange_images=true", "save_predictions=true", f"hydra.run.dir={tmp_path}")
    assert program("evaluate", f"checkpoint={varied_checkpoint}", *data, *exchanged) == 0
    assert "every frame had the picture of another one" in capsys.readouterr().out
    metrics = read_json(tmp_path / "metrics.json")
    assert (metrics["num_frames"], metrics["split"]) == (3, "val")
    found, own = predictions(tmp_path), predictions(evaluation)
    assert found.keys() == own.keys()
    assert len(found) == 3
    assert found != own


def test_split_of_other_data(checkpoint, streets, tmp_path):
    data = ("data=semantickitti", f"data.root={streets}", "data.train_sequences=[0]")
    given = (*data, "split=train", f"hydra.run.dir={tmp_path}")
    assert program("evaluate", f"checkpoint={checkpoint}", *given) == 0
    metrics = read_json(tmp_path / "metrics.json")
    assert (metrics["num_frames"], metrics["split"]) == (1, "train")


def test_figures_by_distance_and_the_confusion_matrix(evaluation, streets):
    metrics = read_json(evaluation / "metrics.json")
    assert list(metrics["by_distance"]) == list(BANDS)
    assert all(0 < scores["IoU"] < 1 for scores in metrics["by_distance"].values())
    data = cli.build(cli.compose("train", ["stage=full", *STREETS, f"data.root={streets}"]).data)
    objects = sum(len(item.target) for item in data.dataset("val"))
    assert number_of_objects(metrics) == objects > 0
    header, *rows = (evaluation / "confusion.csv").read_text().splitlines()
    counts = np.array([row.split(",")[1:] for row in rows], dtype=int)  # rows are the truth
    assert header.split(",")[1:] == list(CLASS_NAMES)
    truth = sum(
        np.bincount(read_labels(frame).ravel(), minlength=256)
        for frame in find_frames(streets, ["08"], stride=5)
    )
    np.testing.assert_array_equal(counts.sum(axis=1), truth[:20])
    assert counts[1:, 1:].sum() / (counts.sum() - counts[0, 0]) == pytest.approx(metrics["IoU"])
    assert cv2.imread(str(evaluation / "confusion.png")).shape == draw_confusion(counts.T).shape
    shown = (evaluation / "output.txt").read_text()
    assert all(band in shown for band in BANDS)
    assert "objects found, in %" in shown


def test_diagnosis_agrees_with_the_figures_and_the_upper_bound(
    evaluation, varied_checkpoint, tmp_path
):
    report, metrics = (
        read_json(evaluation / "diagnosis.json"),
        read_json(evaluation / "metrics.json"),
    )
    assert report["num_frames"] == 3
    assert report["as_predicted"] == {key: metrics[key] for key in report["as_predicted"]}
    assert list(report["alone"]) == list(report["together"]) == list(PREDICTION_PARTS)
    assert report["alone"]["detections"] == report["together"]["detections"]
    objects = sum(sum(errors.values()) - errors["false"] for errors in report["objects"].values())
    assert objects == number_of_objects(metrics)
    best = max(PREDICTION_PARTS, key=lambda part: report["alone"][part]["mIoU"])
    assert report["advice"].startswith(f"Work on the {best}: ")
    shown = (evaluation / "output.txt").read_text()
    assert " ".join(report["advice"].split()) in " ".join(shown.split())
    given = (f"checkpoint={varied_checkpoint}", "upper_bound=true", f"hydra.run.dir={tmp_path}")
    assert program("evaluate", *given) == 0
    upper_bound = read_json(tmp_path / "upper_bound.json")["variants"]["all"]
    last = report["together"]["background classes"]
    assert last == {key: upper_bound[key] for key in last}


def test_diagnosis_of_a_pretrained_checkpoint(runs, tmp_path, capsys):
    """Its occupancy decoder is untrained."""
    pretrained = newest(runs, "pretrain/*/last.ckpt")
    given = (f"checkpoint={pretrained}", "diagnose=true", f"hydra.run.dir={tmp_path}")
    assert program("evaluate", *given) == 0
    assert capsys.readouterr().out.count("untrained decoder") == 1
    report = read_json(tmp_path / "diagnosis.json")
    assert report["together"]["background classes"]["IoU"] > report["as_predicted"]["IoU"]
    given = (*given[:2], "upper_bound=true", f"hydra.run.dir={tmp_path}/bound")
    assert program("evaluate", *given) == 2
    assert "upper_bound=true" in the_error(capsys)


def test_upper_bound_needs_no_checkpoint(streets, tmp_path, capsys):
    settings = ("upper_bound=true", "data=synthetic", f"data.root={streets}", f"outputs={tmp_path}")
    assert program("evaluate", *settings, *STREETS, "model=tiny") == 0
    report = read_json(newest(tmp_path, "evaluate/*/upper_bound.json"))
    assert (report["model"], report["num_frames"]) == ("tiny", 3)
    assert list(report["variants"]) == ["none", *LIMITS, "all"]
    assert 0.8 < report["variants"]["all"]["mIoU_present"] <= 1
    assert program("evaluate", *settings, *STREETS) == 2
    assert "model=" in the_error(capsys)


@pytest.mark.parametrize("choice", ["model=tiny", "partition=all_background"])
@pytest.mark.parametrize("upper_bound", ["upper_bound=false", "upper_bound=true"])
def test_model_and_partition_of_a_checkpoint_are_fixed(choice, upper_bound, tmp_path, capsys):
    given = ("checkpoint=any.ckpt", upper_bound, choice, f"hydra.run.dir={tmp_path}")
    assert program("evaluate", *given) == 2
    line = the_error(capsys)
    assert f"error: {choice}: only for upper_bound=true without a checkpoint" in line
    assert line.endswith(f"has its own {choice.split('=')[0]}: leave it out")
