"""Recordings for rerun, read back by its own command."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import occdetr
from occdetr.errors import InputError
from occdetr.geometry.voxels import GRID_SHAPE
from programs import program, the_error


def entries(file: Path) -> str:
    """What rerun prints of a recording: one line for each piece of it."""
    command = [str(Path(sys.executable).parent / "rerun"), "rrd", "print", "-v", str(file)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def result(camera: occdetr.Camera, size: tuple[int, int] = (120, 160)) -> occdetr.Result:
    grid = np.zeros(GRID_SHAPE, np.uint8)
    grid[30:33, 120:130, :4], grid[60:] = 13, 255
    return occdetr.Result(
        image=np.full((*size, 3), 90, np.uint8),
        grid=grid,
        probabilities=np.where(grid == 255, np.nan, grid > 0).astype(np.float32),
        boxes=np.array([[10.0, 20, 60, 70]]),
        boxes3d=np.array([[9.0, 1, -1, 4, 2, 1.5]]),
        classes=np.array([1]),
        scores=np.array([0.75]),
        camera=camera.for_image(size),
    )


def test_a_recording_holds_images_boxes_and_voxels_of_every_frame(tmp_path) -> None:
    file = tmp_path / "a.rrd"
    found = result(occdetr.Camera.from_fov(70, pitch=-3))
    with occdetr.Recording(file) as recording:
        recording.add(found)
        assert not file.exists()
        recording.add(found, truth=found.grid)
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]
    printed = entries(file)
    for name in (
        *("/world/camera/image/objects", "/world/objects", "/world/voxels", "/truth/voxels"),
        *("Pinhole", "Boxes3D", "Points3D", "EncodedImage", "AnnotationContext"),
    ):
        assert name in printed, name


def test_an_image_of_a_distorted_lens_stands_alone(tmp_path) -> None:
    matrix = [[100.0, 0, 79.5], [0, 100, 59.5], [0, 0, 1]]
    camera = occdetr.Camera.from_intrinsics(matrix, (120, 160), (-0.2, 0.0, 0.0, 0.0))
    with occdetr.Recording(tmp_path / "a.rrd") as recording:
        recording.add(result(camera))
    printed = entries(tmp_path / "a.rrd")
    assert "/image/objects" in printed
    assert "Pinhole" not in printed


def test_an_interrupted_recording_leaves_nothing(tmp_path) -> None:
    with pytest.raises(KeyboardInterrupt), occdetr.Recording(tmp_path / "a.rrd"):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_a_recording_that_cannot_be_written_is_refused_at_once(tmp_path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="folder: is a folder"):
        occdetr.Recording(tmp_path / "folder")
    with pytest.raises(InputError, match="file is a file"):
        occdetr.Recording(tmp_path / "file/a.rrd")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_sigterm_in_an_evaluation_leaves_no_recording(
    checkpoint, streets, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(
        occdetr.Recording, "add_frame", lambda *_: os.kill(os.getpid(), signal.SIGTERM)
    )
    run, before = tmp_path / "run", signal.getsignal(signal.SIGTERM)
    given = [f"checkpoint={checkpoint}", f"data.root={streets}", "trainer=cpu", "viewer=rerun"]
    assert program("evaluate", *given, "pictures=2", f"hydra.run.dir={run}") == 130
    assert "interrupted" in capsys.readouterr().err
    assert not [*run.glob("*.rrd"), *run.glob(".*.tmp"), *run.glob("metrics.json")]
    assert signal.getsignal(signal.SIGTERM) is before


def test_without_rerun_it_says_what_to_install(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match="pip install rerun-sdk"):
        occdetr.Recording(tmp_path / "a.rrd")


def test_prediction_records_all_images(checkpoint, streets, tmp_path, capsys) -> None:
    source, photos = streets / "sequences/08/image_2/000000.png", tmp_path / "photos"
    photos.mkdir()
    for name in ("a.png", "b.png"):
        shutil.copy(source, photos / name)
    given = [f"checkpoint={checkpoint}", f"images={photos}", "camera.fov=80", "device=cpu"]
    run = tmp_path / "run"
    assert program("predict", *given, "viewer=rerun", f"hydra.run.dir={run}") == 0
    assert entries(run / "predictions.rrd").count("/world/camera/image/objects") >= 2
    assert program("predict", *given, "viewer=other", f"hydra.run.dir={tmp_path}/b") == 2
    assert "viewer=other: is not known" in the_error(capsys)


def test_evaluation_records_the_truth_beside(checkpoint, streets, tmp_path, capsys) -> None:
    given = [f"checkpoint={checkpoint}", f"data.root={streets}", "trainer=cpu", "viewer=rerun"]
    run = tmp_path / "run"
    assert program("evaluate", *given, "pictures=2", f"hydra.run.dir={run}") == 0
    printed = entries(run / "predictions.rrd")
    assert printed.count("/truth/voxels") >= 2
    assert "/world/camera/image/objects" in printed
    assert program("evaluate", *given, f"hydra.run.dir={tmp_path}/b") == 2
    assert "also give pictures=" in the_error(capsys)


def test_an_error_before_the_first_frame_leaves_no_recording(checkpoint, tmp_path, capsys) -> None:
    (tmp_path / "data/sequences/08").mkdir(parents=True)
    run, given = tmp_path / "run", [f"checkpoint={checkpoint}", "data=semantickitti"]
    given += [f"data.root={tmp_path}/data", "viewer=rerun", "pictures=1", "trainer=cpu"]
    assert program("evaluate", *given, f"hydra.run.dir={run}") == 2
    assert "sequences/08" in the_error(capsys)
    (tmp_path / "a.png").write_bytes(b"no image")
    (tmp_path / "b.png").write_bytes(b"no image")
    given = [f"checkpoint={checkpoint}", f"images={tmp_path}/*.png", "camera.fov=80", "device=cpu"]
    assert program("predict", *given, "viewer=rerun", f"hydra.run.dir={tmp_path}/run2") == 2
    left = [file.name for folder in ("run", "run2") for file in (tmp_path / folder).iterdir()]
    assert {*left} <= {".hydra"}
