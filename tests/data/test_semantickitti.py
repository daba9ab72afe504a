"""SemanticKITTI's voxel files."""

import numpy as np
import pytest

from occdetr.classes import IGNORE, LEARNING_MAP
from occdetr.data import semantickitti as kitti
from occdetr.data.frames import find_frames
from occdetr.errors import InputError
from occdetr.geometry.voxels import GRID_SHAPE as SHAPE
from scene_factory import one_line_error, write_frame


@pytest.fixture(scope="module")
def grids():
    rng = np.random.default_rng(0)
    raw = rng.choice(np.array(list(LEARNING_MAP), dtype=np.uint16), SHAPE)
    return raw, rng.random(SHAPE) < 0.3


def test_masks_are_packed_bits_highest_first(tmp_path, grids):
    path = tmp_path / "000000.invalid"
    kitti.write_mask(path, grids[1])
    assert path.stat().st_size == 262_144
    np.testing.assert_array_equal(kitti.read_mask(path), grids[1])
    first = path.read_bytes()[0]
    assert [bool(first >> (7 - i) & 1) for i in range(8)] == grids[1].ravel()[:8].tolist()


def test_raw_labels_read_back(tmp_path, grids):
    path = tmp_path / "000000.label"
    kitti.write_raw_labels(path, grids[0])
    assert path.stat().st_size == 4_194_304
    np.testing.assert_array_equal(kitti.read_raw_labels(path), grids[0])
    np.testing.assert_array_equal(np.fromfile(path, dtype="<u2"), grids[0].ravel())


def test_labels_are_remapped_as_by_semantickittis_evaluator():
    raw = np.array([0, 10, 252, 1, 52, 99, 81, 0], dtype=np.uint16)
    invalid = np.array([0, 0, 1, 0, 0, 0, 0, 1], dtype=bool)
    assert kitti.remap_labels(raw).tolist() == [0, 1, 1, IGNORE, IGNORE, IGNORE, 19, 0]
    expected = [0, 1, IGNORE, IGNORE, IGNORE, IGNORE, 19, IGNORE]
    assert kitti.remap_labels(raw, np.packbits(invalid)).tolist() == expected


def test_labels_combine_label_and_invalid_files(tmp_path, grids):
    write_frame(tmp_path, "00", "000000")
    frame = find_frames(tmp_path, ["00"])[0]
    kitti.write_raw_labels(frame.voxel_file("label"), grids[0])
    kitti.write_mask(frame.voxel_file("invalid"), grids[1])
    labels = kitti.read_labels(frame)
    assert labels.dtype == np.uint8
    known = np.array(list(LEARNING_MAP))
    classes = np.array([LEARNING_MAP[i] if LEARNING_MAP[i] or i == 0 else IGNORE for i in known])
    expected = classes[(grids[0][..., None] == known).argmax(-1)]
    np.testing.assert_array_equal(labels, np.where(grids[1], IGNORE, expected))


def test_predictions_read_back_and_have_no_ignored_voxels(tmp_path):
    labels = np.random.default_rng(2).integers(0, 20, SHAPE, dtype=np.uint8)
    path = tmp_path / "predictions" / "000000.label"
    kitti.write_labels(path, labels)
    np.testing.assert_array_equal(kitti.remap_labels(kitti.read_raw_labels(path)), labels)
    labels[0, 0, 0] = IGNORE
    with pytest.raises(ValueError, match="0-19"):
        kitti.write_labels(path, labels)


def test_unknown_raw_ids_are_reported(tmp_path):
    write_frame(tmp_path, "00", "000000")
    frame = find_frames(tmp_path, ["00"])[0]
    raw = np.zeros(SHAPE, dtype=np.uint16)
    raw[3, 4, 5] = 77
    kitti.write_raw_labels(frame.voxel_file("label"), raw)
    kitti.write_mask(frame.voxel_file("invalid"), raw > 0)
    with pytest.raises(InputError) as caught:
        kitti.read_labels(frame)
    assert one_line_error(caught, frame.voxel_file("label"), "id 77")


@pytest.mark.parametrize(
    ("read", "size", "expected", "state"),
    [
        (kitti.read_raw_labels, 1000, "4,194,304", "truncated"),
        (kitti.read_raw_labels, 0, "4,194,304", "truncated"),
        (kitti.read_mask, 262_145, "262,144", "too long"),
    ],
)
def test_files_of_the_wrong_size_are_reported(tmp_path, read, size, expected, state):
    path = tmp_path / "000000.label"
    path.write_bytes(bytes(size))
    with pytest.raises(InputError) as caught:
        read(path)
    assert one_line_error(caught, path, state, expected, f"{size:,} found")


def test_grids_of_the_wrong_shape_are_rejected(tmp_path):
    with pytest.raises((ValueError, TypeError), match=r"shape|Type-check"):
        kitti.write_mask(tmp_path / "x.bin", np.zeros((32, 256, 256), dtype=bool))
