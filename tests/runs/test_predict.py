"""Prediction for pictures: its files, and its equality with evaluation."""

import errno
import os
import re
import shutil
import threading

import numpy as np
import pytest

from occdetr import files
from occdetr.data.semantickitti import read_raw_labels
from occdetr.models import inference
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
    assert "calib.txt: file is missing" in the_error(capsys)
    assert program("predict", *given, f"images={images}", "calib=null") == 2
    assert "calib is not set" in the_error(capsys)


@pytest.fixture
def photos(streets, tmp_path):
    """An image with a name of its own, and a calibration beside the folder."""
    source = streets / "sequences/08"
    (tmp_path / "photos").mkdir()
    shutil.copy(source / "image_2/000000.png", tmp_path / "photos/straße\n[1].png")
    shutil.copy(source / "calib.txt", tmp_path)
    return tmp_path / "photos"


def predict(checkpoint, photos, images, **settings):
    """Predict into the folder ``run`` beside the photos; returns the exit code."""
    folder = photos.parent
    given = {"calib": folder / "calib.txt", "hydra.run.dir": folder / "run", **settings}
    words = [f"{key}={value}" for key, value in given.items()]
    quoted = str(images).replace("\\", "\\\\").replace("'", "\\'")
    return program(
        "predict", f"checkpoint={checkpoint}", f"images='{quoted}'", *words, "device=cpu"
    )


def test_broken_images_are_reported_and_the_others_predicted(checkpoint, photos, capfd):
    (photos / "broken.png").write_bytes((photos / "straße\n[1].png").read_bytes()[:-50])
    (photos / "gone.jpg").symlink_to(photos / "nowhere.jpg")
    (photos / "notes.txt").touch()
    assert predict(checkpoint, photos, photos) == 3
    output = capfd.readouterr()
    lines = output.err.splitlines()
    assert [line.startswith("error: ") for line in lines] == [True, True]
    assert "broken.png: image is truncated" in lines[0]
    assert "gone.jpg: link to" in lines[1]
    assert "skipped what is no image: 1 .txt" in output.out
    assert "done: 1 of 3 images" in output.out
    run = photos.parent / "run"
    report = read_json(run / "predictions.json")
    assert [entry["label"] for entry in report["images"]] == ["straße_[1].label"]
    assert [entry["image"] for entry in report["failed"]] == [
        str(photos / name) for name in ("broken.png", "gone.jpg")
    ]
    assert all((run / entry["picture"]).is_file() for entry in report["images"])


def test_nothing_is_written_if_every_image_is_broken(checkpoint, photos, capfd):
    for name in ("a.png", *photos.iterdir()):
        (photos / name).write_bytes(b"")
    assert predict(checkpoint, photos, photos) == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith("error: ") for line in lines)
    assert "none of 2 images" in lines[-1]
    assert not list((photos.parent / "run").glob("[!.]*"))


def test_an_image_of_a_camera_that_sees_nothing_is_named(checkpoint, photos, capfd):
    camera = {"camera.fov": 80, "camera.yaw": 180, "calib": "null"}
    assert predict(checkpoint, photos, photos, **camera) == 2
    first, last = capfd.readouterr().err.splitlines()
    assert "straße [1].png: the camera sees nothing of the grid" in first
    assert "none of 1 images" in last


def test_images_are_not_overwritten(checkpoint, photos, capsys):
    before = {image: image.read_bytes() for image in photos.iterdir()}
    assert predict(checkpoint, photos, photos, **{"hydra.run.dir": photos}) == 2
    assert "hydra.run.dir" in the_error(capsys)
    assert all(image.read_bytes() == content for image, content in before.items())


def test_the_last_line_says_frames_per_second(checkpoint, photos, capsys):
    assert predict(checkpoint, photos, photos) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert re.search(r"done: 1 image, \d+ objects, \d+\.\d\d frames/s", last)


@pytest.fixture
def three_photos(photos, streets):
    source = streets / "sequences/08/image_2/000000.png"
    for name in ("a.png", "b.png", "c.png"):
        shutil.copy(source, photos / name)
    (photos / "straße\n[1].png").unlink()
    return photos


def test_a_full_disk_ends_the_run_with_whole_files(checkpoint, three_photos, capsys, monkeypatch):
    def write_image(path, image):
        if path.name == "b.png":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        files.write_image(path, image)

    monkeypatch.setattr("occdetr.api.model.write_image", write_image)
    assert predict(checkpoint, three_photos, three_photos) == 2
    line = the_error(capsys)
    assert "b.png" in line
    assert "no space left" in line
    run = three_photos.parent / "run"
    assert (run / "a.png").stat().st_size > 10_000
    assert not (run / "predictions.json").exists()
    assert not list(run.glob(".*.tmp"))


def test_the_network_runs_while_files_are_written(checkpoint, three_photos, monkeypatch):
    second, waited = threading.Event(), []

    def predicted(model, batch, probability):
        if batch.frame_ids == ["b.png"]:
            second.set()
        return inference.predict(model, batch, probability)

    def write_image(path, image):
        waited.append(second.wait(60))
        files.write_image(path, image)

    monkeypatch.setattr("occdetr.api.model.predict", predicted)
    monkeypatch.setattr("occdetr.api.model.write_image", write_image)
    assert predict(checkpoint, three_photos, three_photos) == 0
    assert waited == [True, True, True]


def test_what_is_predicted_before_an_interruption_is_written(
    checkpoint, three_photos, capsys, monkeypatch
):
    def interrupted(model, batch, probability):
        if batch.frame_ids == ["c.png"]:
            raise KeyboardInterrupt
        return inference.predict(model, batch, probability)

    monkeypatch.setattr("occdetr.api.model.predict", interrupted)
    assert predict(checkpoint, three_photos, three_photos) == 130
    assert capsys.readouterr().err.splitlines() == ["interrupted"]
    made = sorted(path.name for path in (three_photos.parent / "run").glob("[!.]*"))
    assert made == ["a.label", "a.png", "b.label", "b.png"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("camera.fov=abc", "camera.fov"),
        ("camera.height=true", "camera.height"),
        ("camera=90", "camera"),
        ("files=png", "files"),
        ("files=[png,obj]", "files: obj is not known"),
        ("merge_doubles=abc", "merge_doubles"),
        ("merge_doubles=2", "merge_doubles=2"),
        ("camera.height=20", "camera.height=20"),
        ("calib=calib.txt", "calib and camera.fov are both given"),
    ],
)
def test_wrong_cameras_and_files_are_one_line(given, message, photos, tmp_path, capsys):
    settings = [f"images={photos}", "camera.fov=70", given, f"hydra.run.dir={tmp_path}/run"]
    assert program("predict", "checkpoint=tiny", *settings) == 2
    assert message in the_error(capsys)
