"""The check of a data set: everything that training refuses, and what is only odd."""

import functools
import pickle
import shutil
import struct
import warnings

import numpy as np
import pytest

from malformed import GRID_BYTES, P2, SIZE, TR, damages, data_set, overwrite, picture, png, remove
from malformed import rename as renamed
from malformed import resize as resized
from occdetr.cli.data_check import places
from occdetr.data.check_dataset import check_dataset
from occdetr.data.datamodule import DatasetFolder
from occdetr.data.findings import ERROR, NOTE, first_fix, group_findings
from occdetr.data.frames import find_frames
from occdetr.data.semantickitti import write_labels, write_mask
from occdetr.errors import InputError
from occdetr.geometry.voxels import GRID_SHAPE
from scene_factory import one_late, shadows, street

#: Damages of files: those that return settings change none.
OF_FILES = {
    name: damage
    for name, damage in damages().items()
    if "settings" not in getattr(damage, "__qualname__", "")
}
part = functools.partial


def checked(folder, damage=lambda sequence: None, whole=10, **settings):
    """The check of a data set of two frames in 00 and 08, which is damaged in 00; it must not be
    usable if its frames are refused."""
    root = folder / "data"
    if not root.exists():
        data_set(damage, folder)
    given = {"train_sequences": ["00"], "val_sequences": ["08"], "test_sequences": []} | settings
    found = check_dataset(DatasetFolder(root, **given), whole, progress=False)
    refusal = None
    with warnings.catch_warnings(action="ignore"):
        try:
            partial = given.get("allow_partial", False)
            sequences = [*given["train_sequences"], *given["val_sequences"]]
            find_frames(root, sequences, given.get("stride", 5), allow_partial=partial)
        except InputError as error:
            refusal = error
    assert refusal is None or not found.usable, refusal
    fix = first_fix(found.findings, places(found))
    assert (fix is None) == found.usable
    return found, fix or ""


def kinds(found, level):
    groups = group_findings(found.findings)
    return {group.kind: len(group.findings) for group in groups if group.level == level}


def test_a_whole_set_has_no_finding(tmp_path):
    found, _ = checked(tmp_path)
    assert found.findings == []
    assert found.whole == 4
    assert [listing.complete for listing in found.listings] == [["000000", "000005"]] * 2
    assert found.images["08"] == {SIZE: 2}
    assert checked(tmp_path, whole=1)[0].whole == 2


@pytest.mark.parametrize("name", OF_FILES)
def test_what_training_refuses_is_an_error(tmp_path, name):
    found, fix = checked(tmp_path, OF_FILES[name])
    assert fix
    assert {each.sequence for each in found.findings if each.level == ERROR} == {"00"}


def move_voxels(sequence):
    other = sequence.parents[1] / "dataset/sequences/00"
    other.mkdir(parents=True)
    (sequence / "voxels").rename(other / "voxels")


def keep_the_archive(sequence):
    (sequence / "image_2").rename(sequence / "image_3")
    (sequence.parents[1] / "data_odometry_color.zip").touch()


def images_of_ten_digits(sequence):
    for name in ("000000", "000005"):
        renamed(f"image_2/{name}.png", f"image_2/0000{name}.png", sequence)


def only_the_second_frame(sequence):
    for kind in GRID_BYTES:
        remove(f"voxels/000000.{kind}", sequence)
    remove("image_2/000000.png", sequence)


def frames_from_one_on(sequence):
    for old, new in (("000000", "000001"), ("000005", "000002")):
        renamed(f"image_2/{old}.png", f"image_2/{new}.png", sequence)
        for kind in GRID_BYTES:
            renamed(f"voxels/{old}.{kind}", f"voxels/{new}.{kind}", sequence)


def renumbered(sequence):
    for kind in GRID_BYTES:
        renamed(f"voxels/000005.{kind}", f"voxels/000001.{kind}", sequence)


def streets(*shifted):
    """Voxels of a street, those of some kinds one voxel late."""

    def write(sequence):
        labels = street()
        grids = {"bin": labels > 0, "invalid": shadows(labels)}
        for kind, grid in grids.items():
            grid = one_late(grid) if kind in shifted else grid
            write_mask(sequence / f"voxels/000000.{kind}", grid)
        labels = one_late(labels) if "label" in shifted else labels
        write_labels(sequence / "voxels/000000.label", labels)

    return write


def three_images_of_two_sizes(sequence):
    overwrite("calib.txt", f"{P2}\n{TR}\n".encode(), sequence)
    overwrite("image_2/000004.png", picture(), sequence)
    overwrite("image_2/000005.png", picture(size=(SIZE[0], SIZE[1] - 1)), sequence)


def lidar(sequence):
    for folder, name, size in (("velodyne", "0.bin", 33), ("velodyne", "1.bin", 32)):
        (sequence / folder).mkdir(exist_ok=True)
        (sequence / folder / name).write_bytes(bytes(size))
    (sequence / "labels").mkdir()
    (sequence / "labels/1.label").write_bytes(bytes(12))


CLASSES = struct.pack("<HH", 9, 15) * (GRID_BYTES["label"] // 4)
MARGIN = png(SIZE[1], SIZE[0], bytes((SIZE[1] + 1) * SIZE[0]), color=0)


@pytest.mark.parametrize(
    ("damage", "kind", "fix", "settings"),
    [
        (move_voxels, "elsewhere", "dataset/sequences", {}),
        (keep_the_archive, "no-images", "data_odometry_color.zip", {}),
        (images_of_ten_digits, "names", "KITTI odometry", {}),
        (only_the_second_frame, "stride", "data.stride", {"stride": 3}),
        (only_the_second_frame, "stride", "data.stride=5", {"stride": 10}),
        (frames_from_one_on, "stride", "data.stride=1", {}),
        (renumbered, "numbers", "every fifth", {}),
        (streets("label", "invalid", "bin"), "late", "1.1", {}),
        (streets("label"), "apart", "1.1", {}),
        (part(overwrite, "voxels/000000.label", CLASSES), "labels", "000000.label", {}),
        (three_images_of_two_sizes, "image-size", "000005.png", {}),
        (part(overwrite, "calib.txt", f"{P2}\n".encode()), "calib", "data_odometry_calib.zip", {}),
        (part(overwrite, "image_2/000010.png", picture()), "end", "data.allow_partial", {}),
        (
            lambda sequence: None,
            "sequence",
            "train_sequences=[0]",
            {"train_sequences": [0, 1]},
        ),
    ],
)
def test_errors_and_their_fixes(tmp_path, damage, kind, fix, settings):
    found, advice = checked(tmp_path, damage, **settings)
    assert next(iter(kinds(found, ERROR))) == kind
    assert fix in advice
    assert "{" not in advice


@pytest.mark.parametrize(
    ("damage", "kind", "settings"),
    [
        (part(overwrite, "image_2/._000000.png", b"x"), "leftovers", {}),
        (part(overwrite, "image_2/000003.jpg", b"x"), "other-files", {}),
        (part(overwrite, "image_2/000003.png", b"x"), "image", {}),
        (part(overwrite, "image_2/000000.png", MARGIN), "gray", {}),
        (part(overwrite, "poses.txt", b"0\n" * 3), "lines", {}),
        (part(overwrite, "calib.txt", f"{P2}\n{TR}\n".encode()), "camera", {}),
        (part(overwrite, "rest.tar.gz", b""), "archives", {}),
        (part(resized, "voxels/000000.bin", 9), "voxels", {}),
        (part(resized, "voxels/000005.occluded", 9), "voxels", {}),
        (lidar, "velodyne", {}),
        (part(overwrite, "times.txt", b"0\n" * 10), None, {}),
        (streets(), None, {}),
        (lambda sequence: None, "other-stride", {"stride": 4}),
        (lambda sequence: None, "sequence", {"test_sequences": ["11"]}),
        (part(remove, "voxels/000005.label"), "missing", {"allow_partial": True}),
        (part(overwrite, "image_2/000010.png", picture()), "end", {"allow_partial": True}),
        (part(remove, "calib.txt"), "no-calib", {"train_sequences": [8]}),
        (part(remove, "calib.txt"), "no-calib", {"train_sequences": [8], "test_sequences": [0]}),
    ],
)
def test_what_is_only_odd_is_a_note(tmp_path, damage, kind, settings):
    found, _ = checked(tmp_path, damage, **settings)
    assert found.usable
    assert list(kinds(found, NOTE)) == ([kind] if kind else [])


def test_frames_that_are_not_read_whole_are_checked_by_their_sizes(tmp_path):
    """An unknown id of the first of two frames is found if both are read, or the first."""
    unknown = struct.pack("<H", 77) + bytes(GRID_BYTES["label"] - 2)
    assert not checked(tmp_path, part(overwrite, "voxels/000005.label", unknown))[0].usable
    assert checked(tmp_path, whole=1)[0].usable
    assert not checked(tmp_path, whole=0)[0].usable


@pytest.mark.parametrize("lowest_layer", [True, False])
def test_scans_of_release_1_0_without_labels(tmp_path, lowest_layer):
    checked(tmp_path)
    grid = np.zeros(GRID_SHAPE, bool)
    grid[10, 20, not lowest_layer : 9] = True
    for number in range(0, 25, 5):
        for name, content in (("image_2/{}.png", picture()), ("voxels/{}.bin", np.packbits(grid))):
            path = tmp_path / "data/sequences/11" / name.format(f"{number:06d}")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    shutil.copy(tmp_path / "data/sequences/08/calib.txt", path.parents[1])
    found, _ = checked(tmp_path, test_sequences=["11"])
    assert kinds(found, NOTE) == ({} if lowest_layer else {"late": 1})
    assert found.whole == 9


def in_pickles(function, jobs, workers):
    """As processes do it, without starting any."""
    for job in jobs:
        yield pickle.loads(pickle.dumps(function(pickle.loads(pickle.dumps(job)))))


def test_parts_in_processes_find_the_same(tmp_path, monkeypatch):
    alone, _ = checked(tmp_path, part(resized, "voxels/000000.label", 9))
    for name, value in {"_FEW": 0, "_CHUNK": 1, "in_processes": in_pickles}.items():
        monkeypatch.setattr(f"occdetr.data.check_dataset.{name}", value)
    folder = DatasetFolder(tmp_path / "data", ["00"], ["08"], [])
    together = check_dataset(folder, workers=2, progress=False)
    assert together.findings == alone.findings
    assert (together.images, together.whole) == (alone.images, 3)
