"""Videos as input and output of predictions."""

from __future__ import annotations

import json
import os
import resource
import signal
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

from occdetr.api.model import Model
from occdetr.api.video import Video, VideoFile, is_video
from occdetr.drawing.panels import video_panel
from occdetr.errors import InputError
from occdetr.geometry.voxels import GRID_SHAPE
from programs import program, the_error


def frame(number: int, size: tuple[int, int] = (120, 160)) -> np.ndarray:
    """A picture whose left edge says which one it is, in steps that compression keeps."""
    image = np.full((*size, 3), 200, np.uint8)
    image[:, :40] = (20 * number, 0, 0)
    return image


def number_of(image: np.ndarray) -> int:
    return round(float(image[40:80, 10:30, 0].mean()) / 20)


@pytest.fixture
def drive(tmp_path) -> Path:
    """Ten frames at 5 a second."""
    with VideoFile(tmp_path / "drive.mp4", 5.0) as video:
        for number in range(10):
            video.add(frame(number))
    return tmp_path / "drive.mp4"


def test_frames_come_back_in_order_and_colour(drive) -> None:
    video = Video(drive)
    assert (video.rate, video.count) == (5.0, 10)
    found = [(number, number_of(image)) for number, image in video]
    assert found == [(number, number) for number in range(10)]
    third = Video(drive, step=3)
    assert third.count == 4
    assert [(number, number_of(image)) for number, image in third] == [(n, n) for n in (0, 3, 6, 9)]
    red = next(iter(Video(drive, step=9)))[1]
    assert red.shape == (120, 160, 3)
    assert red[60, 100].std() < 5  # grey
    assert [path.name for path in drive.parent.iterdir()] == ["drive.mp4"]


def test_a_video_is_known_by_its_frames_if_its_name_does_not_say(drive, tmp_path) -> None:
    bare = drive.rename(tmp_path / "drive")
    assert is_video(bare)
    cv2.imwrite(str(tmp_path / "photo.png"), frame(0))
    photo = (tmp_path / "photo.png").rename(tmp_path / "photo")
    (tmp_path / "text").write_text("no video")
    for other in (photo, tmp_path / "text", tmp_path / "missing", tmp_path):
        assert not is_video(other)


def test_what_is_no_video_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="is missing"):
        Video(tmp_path / "a.mp4")
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match="no frame can be read"):
        Video(tmp_path / "a.mp4")
    with pytest.raises(InputError, match=r"give a file with \.mp4 or \.avi"):
        VideoFile(tmp_path / "a.gif", 10)


def test_a_video_that_ends_early_is_reported(tmp_path) -> None:
    file = tmp_path / "a.avi"
    noise = np.random.default_rng(0).integers(0, 255, (10, 120, 160, 3), np.uint8)
    write_all(file, noise)  # so that half the file is more than its header
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    with pytest.warns(UserWarning, match=r"a\.avi: only \d of 10 frames could be read"):
        found = list(Video(file))
    assert 0 < len(found) < 10


def write_all(file: Path, images: np.ndarray) -> None:
    with VideoFile(file, 10.0) as video:
        for image in images:
            video.add(image)


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_a_full_disk_is_reported(suffix: str, tmp_path) -> None:
    """OpenCV reports nothing."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    noise = np.random.default_rng(0).integers(0, 255, (20, 240, 320, 3), np.uint8)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(InputError, match="of 20 pictures could be written"):
            write_all(tmp_path / f"a{suffix}", noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def interrupted(file: Path) -> None:
    with VideoFile(file, 10.0) as video:
        video.add(frame(0))
        raise KeyboardInterrupt


def test_an_interrupted_video_leaves_nothing(tmp_path) -> None:
    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", [(375, 1242), (1080, 1920), (1920, 1080), (30, 40)])
def test_panels_have_one_size_whatever_the_image(size: tuple[int, int]) -> None:
    grid = np.zeros(GRID_SHAPE, np.uint8)
    grid[20:200, 100:150, :3] = 9
    image = np.full((*size, 3), (10, 200, 90), np.uint8)
    panel = video_panel(image, np.array([[2.0, 3, 20, 25]]), [1], [0.9], grid)
    assert panel.shape == (480, 1280, 3)
    rows, columns = np.nonzero((panel == (10, 200, 90)).all(-1))
    seen = (columns.max() - columns.min() + 1) / (rows.max() - rows.min() + 1)
    assert seen == pytest.approx(size[1] / size[0], rel=0.02)  # not squeezed
    assert columns.max() < 768
    assert len(np.unique(panel[:, 768:].reshape(-1, 3), axis=0)) > 3  # the grid


def test_a_video_is_predicted_frame_by_frame(checkpoint, streets, tmp_path, capsys) -> None:
    image = cv2.imread(str(streets / "sequences/08/image_2/000000.png"))[..., ::-1]
    with VideoFile(tmp_path / "drive.mp4", 5.0) as video:
        for number in range(5):
            video.add(np.ascontiguousarray(np.roll(image, 10 * number, axis=1)))
    given = [f"checkpoint={checkpoint}", f"images={tmp_path}/drive.mp4", "device=cpu"]
    run = tmp_path / "run"
    more = ["camera.fov=80", "frame_step=2", f"hydra.run.dir={run}"]
    assert program("predict", *given, *more) == 0
    entries = json.loads((run / "predictions.json").read_text())["images"]
    assert [(e["frame"], e["seconds"]) for e in entries] == [(0, 0.0), (2, 0.4), (4, 0.8)]
    assert not list(run.glob("*.label"))
    with warnings.catch_warnings(action="error"):
        written = list(Video(run / "predictions.mp4"))
    assert len(written) == 3
    assert written[0][1].shape == (480, 1280, 3)
    assert Video(run / "predictions.mp4").rate == 2.5
    out = tmp_path / "out.avi"
    more = [
        "camera.fov=80",
        "files=[label]",
        f"video={out}",
        "fps=20",
        f"hydra.run.dir={tmp_path}/b",
    ]
    assert program("predict", *given, "frame_step=4", *more) == 0
    assert Video(out).rate == 20
    assert sorted(path.name for path in (tmp_path / "b").glob("*.label")) == [
        "drive_000000.label",
        "drive_000004.label",
    ]
    capsys.readouterr()
    assert program("predict", *given, *more[:-1], f"hydra.run.dir={tmp_path}/c") == 2
    assert "out.avi: exists" in the_error(capsys)


def test_a_video_that_ends_early_is_predicted_and_named(checkpoint, tmp_path, capsys) -> None:
    file = tmp_path / "a.avi"
    write_all(file, np.random.default_rng(0).integers(0, 255, (8, 120, 160, 3), np.uint8))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    given = [f"checkpoint={checkpoint}", f"images={file}", "camera.fov=80", "device=cpu"]
    run = tmp_path / "run"
    assert program("predict", *given, "frame_step=2", f"hydra.run.dir={run}") == 3
    found = json.loads((run / "predictions.json").read_text())
    assert found["images"]
    (failed,) = found["failed"]
    assert "of 8 frames could be read" in failed["error"]
    assert "failed, listed in predictions.json" in capsys.readouterr().out
    assert Video(run / "predictions.mp4").count == len(found["images"])


def test_sigterm_keeps_the_frames_until_then(checkpoint, tmp_path, capsys, monkeypatch) -> None:
    write_all(tmp_path / "a.avi", np.full((12, 120, 160, 3), 90, np.uint8))
    add = VideoFile.add

    def add_and_stop_at_the_third(self: VideoFile, image: np.ndarray) -> None:
        add(self, image)
        if self.count == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(VideoFile, "add", add_and_stop_at_the_third)
    run, before = tmp_path / "run", signal.getsignal(signal.SIGTERM)
    given = [f"checkpoint={checkpoint}", f"images={tmp_path}/a.avi", "camera.fov=80", "device=cpu"]
    assert program("predict", *given, f"hydra.run.dir={run}") == 130
    found = json.loads((run / "predictions.json").read_text())
    assert found["interrupted"]
    assert 2 <= len(found["images"]) <= 3
    with warnings.catch_warnings(action="error"):
        assert len(list(Video(run / "predictions.mp4"))) == 3
    assert not [*run.glob(".*.mp4"), *run.glob(".*.tmp")]
    assert signal.getsignal(signal.SIGTERM) is before
    assert "interrupted" in capsys.readouterr().err


def test_sigterm_before_the_first_frame_leaves_nothing(checkpoint, tmp_path, monkeypatch) -> None:
    write_all(tmp_path / "a.avi", np.full((4, 120, 160, 3), 90, np.uint8))
    monkeypatch.setattr(Model, "run", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    given = [f"checkpoint={checkpoint}", f"images={tmp_path}/a.avi", "camera.fov=80", "device=cpu"]
    assert program("predict", *given, f"hydra.run.dir={tmp_path}/run") == 130
    assert {path.name for path in (tmp_path / "run").iterdir()} <= {".hydra"}


def test_images_give_a_video_too(checkpoint, streets, tmp_path, capsys) -> None:
    folder, calib = streets / "sequences/08/image_2", streets / "sequences/08/calib.txt"
    given = [f"checkpoint={checkpoint}", f"images={folder}", f"calib={calib}", "device=cpu"]
    more = ["files=[]", f"video={tmp_path}/out.mp4", f"hydra.run.dir={tmp_path}/run"]
    assert program("predict", *given, *more) == 0
    assert Video(tmp_path / "out.mp4").count == len(list(folder.glob("*.png")))
    assert Video(tmp_path / "out.mp4").rate == 10
    assert {path.name for path in (tmp_path / "run").iterdir()} <= {"predictions.json", ".hydra"}
    assert program("predict", *given, "frame_step=2", f"hydra.run.dir={tmp_path}/c") == 2
    assert "frame_step=2: only for a video" in the_error(capsys)
