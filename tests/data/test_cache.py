"""Object labels on disk: made once, complete or absent whatever happens to their writers."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
import struct
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
    ObjectCache,
    inputs_key,
    load_objects,
    save_objects,
    settings_key,
)
from occdetr.data.frames import Frame, find_frames
from occdetr.data.objects import ObjectSettings, SceneObjects
from occdetr.data.preparation import LABEL_STEPS, STEPS, FrameResult, prepare_frames
from occdetr.errors import InputError
from occdetr.geometry.voxels import GRID_SHAPE
from scene_factory import write_dataset

CAR = CLASS_NAMES.index("car")
EVERY_PIXEL = ObjectSettings(ray_stride=1)
FORK = multiprocessing.get_context(
    "fork"
)  # forked processes start in milliseconds, with compiled code


@pytest.fixture
def frame_files(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "set", num_frames=3)
    return tmp_path


def _same(a: SceneObjects, b: SceneObjects) -> bool:
    pairs = zip(a.arrays().values(), b.arrays().values(), strict=True)
    return all(np.array_equal(x, y) and x.dtype == y.dtype for x, y in pairs)


def test_cached_objects_equal_those_built(
    frame_files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    built = ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame)
    assert len(built) == 2
    monkeypatch.setattr(cache, "extract_objects", lambda *args: pytest.fail("built again"))
    assert _same(built, ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame))
    assert (
        len(ObjectCache(ObjectSettings(classes=()), frame_files / "cache").load_or_build(frame))
        == 0
    )


def test_changed_settings_and_files_are_noticed(frame_files: Path) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame)
    only_cars = ObjectSettings(classes=(CAR,), ray_stride=1)
    assert ObjectCache(only_cars, frame_files / "cache").load_or_build(frame).classes.tolist() == [
        CAR
    ]

    road = struct.pack("<H", 40) * math.prod(GRID_SHAPE)  # no object
    cache.write_atomically(frame.voxel_file("label"), road)
    assert len(ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame)) == 0

    path = ObjectCache(EVERY_PIXEL, frame_files / "cache").file(frame)
    before = path.stat().st_mtime_ns
    os.utime(frame.image, ns=(1, 1))
    ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame)
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
def test_the_key_depends_on_every_setting(keywords: dict) -> None:
    assert settings_key(ObjectSettings(**keywords)) != settings_key(ObjectSettings())


def test_truncated_cache_files_are_made_again(frame_files: Path) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    built = ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame)
    path = ObjectCache(EVERY_PIXEL, frame_files / "cache").file(frame)
    data = path.read_bytes()
    for length in (0, 1, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        assert _same(built, ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame))
        assert path.read_bytes() == data


def test_a_folder_that_cannot_be_written_is_reported(frame_files: Path) -> None:
    frames = find_frames(frame_files / "set", ["00"])
    blocked = frame_files / "blocked"
    blocked.write_text("a file, not a folder")
    with pytest.warns(UserWarning, match="not kept"):
        assert len(ObjectCache(EVERY_PIXEL, blocked).load_or_build(frames[0])) == 2
    with pytest.raises(InputError, match=r"cache_dir"):
        prepare_frames(frames, ObjectCache(EVERY_PIXEL, blocked), progress=False)


def test_missing_labels_are_reported(frame_files: Path) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    frame.voxel_file("label").unlink()
    with pytest.raises(InputError, match=r"000000\.label"):
        ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame)


def test_every_flipped_bit_is_noticed(frame_files: Path) -> None:
    """In arrays and in headers."""
    frame = find_frames(frame_files / "set", ["00"])[0]
    ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frame)
    path, key = ObjectCache(EVERY_PIXEL, frame_files / "cache").file(frame), inputs_key(frame)
    data, rng = path.read_bytes(), np.random.default_rng(0)
    assert load_objects(path, key) is not None
    for position in rng.choice(len(data), 2000, replace=False):
        flipped = bytearray(data)
        flipped[position] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        assert load_objects(path, key) is None, position


# many frames


@pytest.mark.parametrize("num_workers", [1, 2])
def test_preparation_continues_after_an_interruption(frame_files: Path, num_workers: int) -> None:
    frames = find_frames(frame_files / "set", ["00"])
    ObjectCache(EVERY_PIXEL, frame_files / "cache").load_or_build(frames[1])
    seen: list[FrameResult] = []
    done = prepare_frames(
        frames,
        ObjectCache(EVERY_PIXEL, frame_files / "cache"),
        num_workers,
        progress=False,
        on_frame=seen.append,
    )
    assert (done.built, done.reused, done.objects) == (2, 1, 6)
    assert seen == done.frames
    for frame in frames:
        path = ObjectCache(EVERY_PIXEL, frame_files / "cache").file(frame)
        assert load_objects(path, inputs_key(frame)) is not None


def test_preparation_measures_the_time_of_each_step(frame_files: Path) -> None:
    frames, place = find_frames(frame_files / "set", ["00"]), frame_files / "cache"
    done = prepare_frames(frames, ObjectCache(EVERY_PIXEL, place), progress=False)
    for frame in done.frames:
        assert set(frame.seconds) == set(STEPS)
        assert min(frame.seconds.values()) > 0
    assert sum(sum(frame.seconds.values()) for frame in done.frames) <= done.seconds
    labels = done.median_seconds(LABEL_STEPS)
    parts = [done.median_seconds([part]) for part in LABEL_STEPS]
    assert max(parts) < labels < done.median_seconds(STEPS)
    again = prepare_frames(frames, ObjectCache(EVERY_PIXEL, place), progress=False)
    assert (again.reused, again.median_seconds(STEPS)) == (3, None)


def test_compilation_is_not_measured(frame_files: Path) -> None:
    code = """if True:
        import sys
        from pathlib import Path
        from occdetr.data.cache import ObjectCache
        from occdetr.data.objects import ObjectSettings
        from occdetr.data.preparation import LABEL_STEPS, prepare_frames
        from occdetr.data.frames import find_frames
        frames = find_frames(sys.argv[1], ["00"])[:1]
        cache = ObjectCache(ObjectSettings(), Path(sys.argv[2]))
        done = prepare_frames(frames, cache, progress=False)
        print(done.median_seconds(LABEL_STEPS) / done.seconds)
    """
    command = [sys.executable, "-c", code, str(frame_files / "set"), str(frame_files / "cache")]
    nothing = os.environ | {
        "NUMBA_CACHE_DIR": str(frame_files / "numba")
    }  # empty: everything is compiled again
    done = subprocess.run(command, env=nothing, capture_output=True, text=True, check=True)
    assert 0 < float(done.stdout) < 0.1


def test_rebuild_replaces_the_files(frame_files: Path) -> None:
    frames, place = find_frames(frame_files / "set", ["00"]), frame_files / "cache"
    prepare_frames(frames, ObjectCache(EVERY_PIXEL, place), progress=False)
    paths = [ObjectCache(EVERY_PIXEL, place).file(frame) for frame in frames]
    before = [(path.read_bytes(), path.stat().st_ino) for path in paths]
    done = prepare_frames(frames, ObjectCache(EVERY_PIXEL, place), progress=False, rebuild=True)
    assert (done.built, done.reused) == (3, 0)
    for path, (data, inode) in zip(paths, before, strict=True):
        assert path.read_bytes() == data
        assert path.stat().st_ino != inode  # replaced by a new file


# parallel and killed processes


def _train_forever(frames: list[Frame], place: Path) -> None:
    """Build missing labels, as data workers do."""
    for frame in itertools.cycle(frames):
        ObjectCache(EVERY_PIXEL, place).file(frame).unlink(missing_ok=True)
        ObjectCache(EVERY_PIXEL, place).load_or_build(frame)


def _prepare_forever(frames: list[Frame], place: Path) -> None:
    while True:
        prepare_frames(frames, ObjectCache(EVERY_PIXEL, place), progress=False, rebuild=True)


@pytest.fixture
def slow_disk(frame_files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write files slowly in small pieces, so that processes are often killed while they write."""

    def write(path: Path, data: bytes) -> None:
        with path.open("wb", buffering=0) as file:
            for start in range(0, len(data), 1000):
                file.write(data[start : start + 1000])
                time.sleep(0.0003)

    monkeypatch.setattr(Path, "write_bytes", write)


@pytest.mark.usefixtures("slow_disk")
def test_killed_writers_leave_complete_files_or_none(frame_files: Path) -> None:
    frames, place = find_frames(frame_files / "set", ["00"]), frame_files / "cache"
    began = time.monotonic()
    written = ObjectCache(EVERY_PIXEL, frame_files / "fresh")
    prepare_frames(frames, written, progress=False)
    longest = min(max(0.2, 3 * (time.monotonic() - began)), 1.0)  # more on a busy machine
    fresh = {
        ObjectCache(EVERY_PIXEL, place).file(frame): written.file(frame).read_bytes()
        for frame in frames
    }

    def check() -> int:
        """Compare every file with a fresh one; returns the number of files."""
        found = 0
        for path, expected in fresh.items():
            try:
                assert path.read_bytes() == expected
            except FileNotFoundError:
                continue
            found += 1
        return found

    rng, found = np.random.default_rng(0), []
    for _ in range(30):
        writers = [
            FORK.Process(target=target, args=(frames, place))
            for target in rng.choice([_train_forever, _prepare_forever], size=rng.integers(1, 4))
        ]
        for writer in writers:
            writer.start()
        end = time.monotonic() + rng.uniform(0, longest)
        while time.monotonic() < end:
            check()  # read at the same time
            time.sleep(0.001)
        for writer in writers:
            writer.kill()
        for writer in writers:
            writer.join()
            assert writer.exitcode == -9
        found.append(check())
        for frame in frames:
            path = ObjectCache(EVERY_PIXEL, place).file(frame)
            assert path.exists() == (load_objects(path, inputs_key(frame)) is not None)
    assert min(found) < max(found)  # some were killed before the files were there, some after
    assert _temporaries(place)  # and some while they were written

    prepare_frames(frames, ObjectCache(EVERY_PIXEL, place), progress=False)
    assert check() == 3


def _temporaries(place: Path) -> list[Path]:
    return sorted(ObjectCache(EVERY_PIXEL, place).folder.glob("*/.*.tmp"))


def _save_often(frame: Frame, place: Path, start: Callable[[], int]) -> None:
    objects = cache.build_objects(frame, EVERY_PIXEL)
    start()
    for _ in range(30):
        save_objects(ObjectCache(EVERY_PIXEL, place).file(frame), objects, inputs_key(frame))


def test_many_writers_of_one_frame_leave_one_complete_file(frame_files: Path) -> None:
    frame = find_frames(frame_files / "set", ["00"])[0]
    expected = cache.build_objects(frame, EVERY_PIXEL)
    start = FORK.Barrier(8)
    writers = [
        FORK.Process(target=_save_often, args=(frame, frame_files / "cache", start.wait))
        for _ in range(8)
    ]
    for writer in writers:
        writer.start()
    path, key = ObjectCache(EVERY_PIXEL, frame_files / "cache").file(frame), inputs_key(frame)
    while any(writer.is_alive() for writer in writers):
        if path.exists():  # from then on it is always complete
            objects = load_objects(path, key)
            assert objects is not None
            assert _same(objects, expected)
    assert [writer.exitcode for writer in writers] == [0] * 8
    assert list((frame_files / "cache").rglob("*.*")) == [path]


@pytest.mark.usefixtures("slow_disk")
@pytest.mark.parametrize("entry", ["training", "preparation"])
def test_old_temporary_files_are_removed(frame_files: Path, entry: str) -> None:
    frame, place = find_frames(frame_files / "set", ["00"])[0], frame_files / "cache"
    path = ObjectCache(EVERY_PIXEL, place).file(frame)
    path.parent.mkdir(parents=True)
    for pause in np.arange(0.01, 1, 0.01):
        writer = FORK.Process(target=_prepare_forever, args=([frame], place))
        writer.start()
        time.sleep(pause)
        writer.kill()
        writer.join()
        if _temporaries(place):  # it was killed while writing
            break
    (old,) = _temporaries(place)
    path.unlink(missing_ok=True)  # if an earlier pass left it, nothing would be built
    then = time.time() - STALE_AFTER - 60
    os.utime(old, (then, then))
    young = old.with_name(f".{path.name}.0123.tmp")  # of another running writer
    other = old.with_name(".notes.tmp")
    for file in (young, other):
        file.write_bytes(b"half")
    os.utime(other, (then, then))
    if entry == "training":
        ObjectCache(EVERY_PIXEL, place).load_or_build(frame)
    else:
        prepare_frames([frame], ObjectCache(EVERY_PIXEL, place), progress=False)
    assert _temporaries(place) == sorted([young, other])
    assert path.exists()
