"""Object labels on disk: whole whatever happens to their writers, made once, by many at a time."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from occdetr.classes import CLASS_NAMES
from occdetr.data import cache
from occdetr.data.cache import (
    STALE_AFTER,
    cache_file,
    inputs_key,
    load_objects,
    load_or_build,
    save_objects,
    settings_folder,
    settings_key,
)
from occdetr.data.frames import Frame, find_frames
from occdetr.data.objects import ObjectSettings, SceneObjects
from occdetr.data.preparation import LABEL_PARTS, PARTS, PreparedFrame, prepare_frames
from occdetr.errors import InputError
from occdetr.geometry.rois import preset_rois
from scene_factory import write_dataset

CAR = CLASS_NAMES.index("car")
EVERY_PIXEL = ObjectSettings(ray_stride=1)
ROIS = preset_rois((64, 208), (8, 16), 2.0)
FORK = multiprocessing.get_context("fork")  # processes that start warm, in milliseconds


@pytest.fixture
def frame_files(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "set", num_frames=3)
    return tmp_path


def _same(a: SceneObjects, b: SceneObjects) -> bool:
    pairs = zip(a.arrays().values(), b.arrays().values(), strict=True)
    return all(np.array_equal(x, y) and x.dtype == y.dtype for x, y in pairs)


def test_cache_returns_what_was_built(frame_files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    built = load_or_build(frame, EVERY_PIXEL, frame_files / "cache")
    assert len(built) == 2
    monkeypatch.setattr(cache, "extract_objects", lambda *args: pytest.fail("built again"))
    assert _same(built, load_or_build(frame, EVERY_PIXEL, frame_files / "cache"))
    assert len(load_or_build(frame, ObjectSettings(classes=()), frame_files / "cache")) == 0


def test_cache_follows_settings_and_files(frame_files: Path) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    load_or_build(frame, EVERY_PIXEL, frame_files / "cache")
    only_cars = ObjectSettings(classes=(CAR,), ray_stride=1)
    assert load_or_build(frame, only_cars, frame_files / "cache").classes.tolist() == [CAR]

    cache.write_atomically(frame.voxel_file("label"), bytes(4_194_304))
    assert len(load_or_build(frame, EVERY_PIXEL, frame_files / "cache")) == 0

    path = cache_file(frame, EVERY_PIXEL, frame_files / "cache")
    before = path.stat().st_mtime_ns
    os.utime(frame.image, ns=(1, 1))
    load_or_build(frame, EVERY_PIXEL, frame_files / "cache")
    assert path.stat().st_mtime_ns > before


@pytest.mark.parametrize(
    "keywords",
    [
        {"classes": (CAR,)},
        {"distance": {"car": 0.8}},
        {"min_voxels": {"car": 11}},
        {"ray_stride": 1},
        {"min_visible_pixels": 2},
    ],
)
def test_every_setting_has_its_own_files(keywords: dict) -> None:
    assert settings_key(ObjectSettings(**keywords)) != settings_key(ObjectSettings())


def test_truncated_cache_files_are_made_again(frame_files: Path) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    built = load_or_build(frame, EVERY_PIXEL, frame_files / "cache")
    path = cache_file(frame, EVERY_PIXEL, frame_files / "cache")
    data = path.read_bytes()
    for length in (0, 1, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        assert _same(built, load_or_build(frame, EVERY_PIXEL, frame_files / "cache"))
        assert path.read_bytes() == data


def test_folder_that_cannot_be_written(frame_files: Path) -> None:
    frames = find_frames(frame_files / "set", ["00"])
    blocked = frame_files / "blocked"
    blocked.write_text("a file, not a folder")
    with pytest.warns(UserWarning, match="not kept"):
        assert len(load_or_build(frames[0], EVERY_PIXEL, blocked)) == 2
    with pytest.raises(InputError, match=r"cache_dir"):
        prepare_frames(frames, EVERY_PIXEL, blocked, progress=False)


def test_missing_label_is_named(frame_files: Path) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    frame.voxel_file("label").unlink()
    with pytest.raises(InputError, match=r"000000\.label"):
        load_or_build(frame, EVERY_PIXEL, frame_files / "cache")


def test_no_flipped_bit_is_taken(frame_files: Path) -> None:
    """Wherever it is: in an array, or in a header that could turn it into another array."""
    frame = find_frames(frame_files / "set", ["00"])[0]
    load_or_build(frame, EVERY_PIXEL, frame_files / "cache")
    path, key = cache_file(frame, EVERY_PIXEL, frame_files / "cache"), inputs_key(frame)
    data, rng = path.read_bytes(), np.random.default_rng(0)
    assert load_objects(path, key) is not None
    for position in rng.choice(len(data), 2000, replace=False):
        flipped = bytearray(data)
        flipped[position] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        assert load_objects(path, key) is None, position


# many frames


@pytest.mark.parametrize("num_workers", [1, 2])
def test_prepare_goes_on_where_it_stopped(frame_files: Path, num_workers: int) -> None:
    frames = find_frames(frame_files / "set", ["00"])
    load_or_build(frames[1], EVERY_PIXEL, frame_files / "cache")
    seen: list[PreparedFrame] = []
    done = prepare_frames(
        frames,
        EVERY_PIXEL,
        frame_files / "cache",
        num_workers,
        progress=False,
        on_frame=seen.append,
    )
    assert (done.built, done.reused, done.objects) == (2, 1, 6)
    assert seen == done.frames
    for frame in frames:
        path = cache_file(frame, EVERY_PIXEL, frame_files / "cache")
        assert load_objects(path, inputs_key(frame)) is not None


def test_preparation_tells_where_its_time_goes(frame_files: Path) -> None:
    frames, place = find_frames(frame_files / "set", ["00"]), frame_files / "cache"
    done = prepare_frames(frames, EVERY_PIXEL, place, progress=False, rois=ROIS)
    for frame in done.frames:
        assert set(frame.seconds) == set(PARTS)
        assert min(frame.seconds.values()) > 0
    assert sum(sum(frame.seconds.values()) for frame in done.frames) <= done.seconds
    labels = done.median_seconds(LABEL_PARTS)
    parts = [done.median_seconds([part]) for part in LABEL_PARTS]
    assert max(parts) < labels < done.median_seconds(PARTS)
    again = prepare_frames(frames, EVERY_PIXEL, place, progress=False)
    assert (again.reused, again.median_seconds(PARTS)) == (3, None)


def test_compilation_is_off_the_clock(frame_files: Path) -> None:
    code = """if True:
        import sys
        from occdetr.data.objects import ObjectSettings
        from occdetr.data.preparation import LABEL_PARTS, prepare_frames
        from occdetr.data.frames import find_frames
        frames = find_frames(sys.argv[1], ["00"])[:1]
        done = prepare_frames(frames, ObjectSettings(), sys.argv[2], progress=False)
        print(done.median_seconds(LABEL_PARTS) / done.seconds)
    """
    command = [sys.executable, "-c", code, str(frame_files / "set"), str(frame_files / "cache")]
    nothing = os.environ | {"NUMBA_CACHE_DIR": str(frame_files / "numba")}  # is compiled yet
    done = subprocess.run(command, env=nothing, capture_output=True, text=True, check=True)
    assert 0 < float(done.stdout) < 0.1


def test_labels_can_be_made_anew(frame_files: Path) -> None:
    frames, place = find_frames(frame_files / "set", ["00"]), frame_files / "cache"
    prepare_frames(frames, EVERY_PIXEL, place, progress=False)
    paths = [cache_file(frame, EVERY_PIXEL, place) for frame in frames]
    before = [(path.read_bytes(), path.stat().st_ino) for path in paths]
    done = prepare_frames(frames, EVERY_PIXEL, place, progress=False, rebuild=True)
    assert (done.built, done.reused) == (3, 0)
    for path, (data, inode) in zip(paths, before, strict=True):
        assert path.read_bytes() == data
        assert path.stat().st_ino != inode  # another file took its place


# many processes, and killed ones


def _train_forever(frames: list[Frame], place: Path) -> None:
    """As data workers do: what is missing is built."""
    for frame in itertools.cycle(frames):
        cache_file(frame, EVERY_PIXEL, place).unlink(missing_ok=True)
        load_or_build(frame, EVERY_PIXEL, place)


def _prepare_forever(frames: list[Frame], place: Path) -> None:
    while True:
        prepare_frames(frames, EVERY_PIXEL, place, progress=False, rebuild=True)


@pytest.fixture
def slow_disk(frame_files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once the frames are there, files grow piece by piece: many a kill finds one half written."""

    def write(path: Path, data: bytes) -> None:
        with path.open("wb", buffering=0) as file:
            for start in range(0, len(data), 1000):
                file.write(data[start : start + 1000])
                time.sleep(0.0003)

    monkeypatch.setattr(Path, "write_bytes", write)


@pytest.mark.usefixtures("slow_disk")
def test_killed_writers_leave_whole_labels_or_none(frame_files: Path) -> None:
    frames, place = find_frames(frame_files / "set", ["00"]), frame_files / "cache"
    prepare_frames(frames, EVERY_PIXEL, frame_files / "fresh", progress=False)
    fresh = {
        cache_file(frame, EVERY_PIXEL, place): cache_file(
            frame, EVERY_PIXEL, frame_files / "fresh"
        ).read_bytes()
        for frame in frames
    }

    def check() -> int:
        """Compare every file that is there with a fresh one; how many there are."""
        found = 0
        for path, expected in fresh.items():
            try:
                assert path.read_bytes() == expected
            except FileNotFoundError:
                continue
            found += 1
        return found

    rng, found = np.random.default_rng(0), []
    for _ in range(50):
        writers = [
            FORK.Process(target=target, args=(frames, place))
            for target in rng.choice([_train_forever, _prepare_forever], size=rng.integers(1, 4))
        ]
        for writer in writers:
            writer.start()
        end = time.monotonic() + rng.uniform(0, 0.2)
        while time.monotonic() < end:
            check()  # a reader beside them
        for writer in writers:
            writer.kill()
        for writer in writers:
            writer.join()
            assert writer.exitcode == -9
        found.append(check())
        for frame in frames:
            path = cache_file(frame, EVERY_PIXEL, place)
            assert path.exists() == (load_objects(path, inputs_key(frame)) is not None)
    assert min(found) < max(found)  # killed before files were there, and after
    assert _temporaries(place)  # and while they were written

    prepare_frames(frames, EVERY_PIXEL, place, progress=False)
    assert check() == 3


def _temporaries(place: Path) -> list[Path]:
    return sorted(settings_folder(EVERY_PIXEL, place).glob("*/.*.tmp"))


def _save_often(frame: Frame, place: Path, start: Callable[[], int]) -> None:
    objects = cache.build_objects(frame, EVERY_PIXEL)
    start()
    for _ in range(30):
        save_objects(cache_file(frame, EVERY_PIXEL, place), objects, inputs_key(frame))


def test_many_writers_of_one_frame_leave_one_file(frame_files: Path) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    expected = cache.build_objects(frame, EVERY_PIXEL)
    start = FORK.Barrier(8)
    writers = [
        FORK.Process(target=_save_often, args=(frame, frame_files / "cache", start.wait))
        for _ in range(8)
    ]
    for writer in writers:
        writer.start()
    path, key = cache_file(frame, EVERY_PIXEL, frame_files / "cache"), inputs_key(frame)
    while any(writer.is_alive() for writer in writers):
        if path.exists():  # and from then on it is whole at any moment
            objects = load_objects(path, key)
            assert objects is not None
            assert _same(objects, expected)
    assert [writer.exitcode for writer in writers] == [0] * 8
    assert list((frame_files / "cache").rglob("*.*")) == [path]


@pytest.mark.usefixtures("slow_disk")
@pytest.mark.parametrize("entry", ["training", "preparation"])
def test_what_killed_writers_left_goes_when_it_is_old(frame_files: Path, entry: str) -> None:
    frame, place = find_frames(frame_files / "set", ["00"])[0], frame_files / "cache"
    path = cache_file(frame, EVERY_PIXEL, place)
    path.parent.mkdir(parents=True)
    for pause in np.arange(0.01, 1, 0.01):
        writer = FORK.Process(target=_prepare_forever, args=([frame], place))
        writer.start()
        time.sleep(pause)
        writer.kill()
        writer.join()
        if _temporaries(place):  # it was killed while it wrote
            break
    (old,) = _temporaries(place)
    path.unlink(missing_ok=True)  # whole from a pass before, it would leave nothing to make
    then = time.time() - STALE_AFTER - 60
    os.utime(old, (then, then))
    young = old.with_name(f".{path.name}.0123.tmp")  # of a writer beside us
    other = old.with_name(".notes.tmp")
    for file in (young, other):
        file.write_bytes(b"half")
    os.utime(other, (then, then))
    if entry == "training":
        load_or_build(frame, EVERY_PIXEL, place)
    else:
        prepare_frames([frame], EVERY_PIXEL, place, progress=False)
    assert _temporaries(place) == sorted([young, other])
    assert path.exists()
