import os
import re

import numpy as np
import pytest

from occdetr.classes import IGNORE, LEARNING_MAP
from occdetr.data import semantickitti as kitti
from occdetr.data.frames import find_frames, summarize_frames
from occdetr.errors import InputError
from occdetr.files import read_image, write_atomically, write_image
from occdetr.geometry import voxels
from occdetr.geometry.kitti import Calibration, read_calibration, write_calibration

SHAPE = voxels.GRID_SHAPE
PROJECTION = np.array([[718.856, 0, 607.2, 45.38], [0, 718.856, 185.2, -0.113], [0, 0, 1, 0.0038]])
LIDAR_TO_CAMERA = np.array([[0, -1, 0, -0.01], [0, 0, -1, -0.054], [1, 0, 0, -0.29], [0, 0, 0, 1]])
CALIBRATION = Calibration(PROJECTION, LIDAR_TO_CAMERA)


@pytest.fixture(scope="module")
def grids():
    rng = np.random.default_rng(0)
    raw = rng.choice(np.array(list(LEARNING_MAP), dtype=np.uint16), SHAPE)
    return raw, rng.random(SHAPE) < 0.3


def write_frame(root, sequence, name, kinds=("label", "invalid", "bin")):
    """Files of a frame that exist; what they hold does not matter to ``find_frames``."""
    folder = root / "sequences" / sequence
    for path in [folder / "image_2" / f"{name}.png"] + [
        folder / "voxels" / f"{name}.{kind}" for kind in kinds
    ]:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    if not (folder / "calib.txt").exists():
        write_calibration(folder / "calib.txt", CALIBRATION)


def one_line_error(caught, *parts):
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert str(part) in message
    return True


# ---------------------------------------------------------------------------- finding frames


def test_finds_frames_in_order_and_only_complete_ones(tmp_path):
    for name in ("000010", "000000", "000005", "000007"):
        write_frame(tmp_path, "08", name)
    write_frame(tmp_path, "08", "000015", kinds=("label",))  # no .invalid
    write_frame(tmp_path, "00", "000020")
    (tmp_path / "sequences/08/image_2/000005.png").unlink()
    (tmp_path / "sequences/08/image_2/._000000.png").touch()  # what archivers leave behind
    frames = find_frames(tmp_path, ["08", "00"], stride=5)
    assert [frame.id for frame in frames] == ["08/000000", "08/000010", "00/000020"]
    assert frames[0].image == tmp_path / "sequences/08/image_2/000000.png"
    assert frames[0].voxel_file("invalid") == tmp_path / "sequences/08/voxels/000000.invalid"
    assert len(find_frames(tmp_path, ["08"], stride=1)) == 3
    assert summarize_frames(frames, 5) == "3 frames (sequences 08, 00, stride 5)"
    assert summarize_frames(frames[:1], 5) == "1 frame (sequence 08, stride 5)"


def test_sequences_may_be_numbers_as_yaml_reads_them(tmp_path):
    write_frame(tmp_path, "08", "000000")
    assert find_frames(tmp_path, [8]) == find_frames(str(tmp_path), ["08"])
    assert find_frames(tmp_path, "08") == find_frames(tmp_path, ["08"])


def test_the_test_split_has_no_labels(tmp_path):
    write_frame(tmp_path, "11", "000000", kinds=("bin",))
    write_frame(tmp_path, "11", "000001", kinds=())
    write_frame(tmp_path, "12", "000003", kinds=())  # no voxels folder: the pictures are the frames
    frames = find_frames(tmp_path, ["11", "12"], stride=1, labels=False)
    assert [frame.id for frame in frames] == ["11/000000", "12/000003"]
    assert frames[1].voxels is None
    with pytest.raises(InputError) as caught:
        frames[1].voxel_file("label")
    assert one_line_error(caught, "12/000003")
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, ["11"], stride=1, labels=True)
    assert one_line_error(caught, "2 image_2/*.png", "0 voxels/*.label")


def test_missing_folders_are_named(tmp_path):
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path / "nowhere", ["08"])
    assert one_line_error(caught, tmp_path / "nowhere", "data.root")
    write_frame(tmp_path, "00", "000000")
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, ["00", "08"])
    assert one_line_error(caught, tmp_path / "sequences/08", "found: 00")
    (tmp_path / "sequences/00/calib.txt").unlink()
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, ["00"])
    assert one_line_error(caught, tmp_path / "sequences/00/calib.txt", "missing")


def test_a_stride_that_finds_nothing_says_which_would(tmp_path):
    for number in (1, 2, 4, 6):
        write_frame(tmp_path, "08", f"{number:06d}")
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, ["08"], stride=5)
    assert one_line_error(caught, "stride 5", "stride 1 finds 4", "stride 2 finds 3")


@pytest.mark.parametrize(
    ("sequences", "stride", "part"),
    [(["08"], 0, "stride=0"), (["x"], 5, "'x'"), ([], 5, "name at")],
)
def test_bad_settings_are_named(tmp_path, sequences, stride, part):
    write_frame(tmp_path, "08", "000000")
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, sequences, stride)
    assert one_line_error(caught, part)


# ---------------------------------------------------------------------------- calibration


def test_calibration_reads_back_exactly(tmp_path):
    path = tmp_path / "calib.txt"
    write_calibration(path, CALIBRATION)
    read = read_calibration(path)
    np.testing.assert_array_equal(read.projection, PROJECTION)
    np.testing.assert_array_equal(read.lidar_to_camera, LIDAR_TO_CAMERA)


def test_calibration_takes_p2_and_tr_out_of_a_real_file(tmp_path):
    path = tmp_path / "calib.txt"
    rows = {
        name: np.arange(12) + 12 * i + 1 for i, name in enumerate(["P0", "P1", "P2", "P3", "Tr"])
    }
    lines = [f"{name}: {' '.join(f'{v:e}' for v in row)}" for name, row in rows.items()]
    path.write_text("calib_time: 09-Jan-2012 13:57:47\r\n" + "\r\n".join(lines) + "\r\n\r\n")
    read = read_calibration(path)
    np.testing.assert_array_equal(read.projection.ravel(), rows["P2"])
    np.testing.assert_array_equal(read.lidar_to_camera[:3].ravel(), rows["Tr"])
    np.testing.assert_array_equal(read.lidar_to_camera[3], [0, 0, 0, 1])


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda text: re.sub(r"Tr:.*\n", "", text), ["'Tr:' is missing"]),
        (lambda text: text.replace("P2", "P3"), ["'P2:' is missing"]),
        (lambda text: text.replace("Tr: ", "Tr: 1.0 "), ["'Tr:'", "12 numbers"]),
        (lambda text: text.replace("P2: ", "P2: x"), ["'P2:'", "12 numbers"]),
        (lambda text: text.replace("P2: ", "P2: -"), ["'P2:'", "focal"]),
        (lambda text: "", ["'P2:' is missing"]),
    ],
)
def test_broken_calibration_names_file_and_line(tmp_path, change, parts):
    path = tmp_path / "calib.txt"
    write_calibration(path, CALIBRATION)
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError) as caught:
        read_calibration(path)
    assert one_line_error(caught, path, *parts)


def test_missing_or_binary_calibration_is_one_line(tmp_path):
    with pytest.raises(InputError) as caught:
        read_calibration(tmp_path / "calib.txt")
    assert one_line_error(caught, tmp_path / "calib.txt", "missing")
    (tmp_path / "calib.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError) as caught:
        read_calibration(tmp_path / "calib.txt")
    assert one_line_error(caught, tmp_path / "calib.txt", "cannot be read")


# ---------------------------------------------------------------------------- images


def test_image_is_rgb_and_reads_back(tmp_path):
    image = np.random.default_rng(1).integers(0, 256, (7, 11, 3), dtype=np.uint8)
    path = tmp_path / "fotoß" / "000000.png"
    write_image(path, image)
    np.testing.assert_array_equal(read_image(path), image)


def test_unreadable_image_is_one_line_and_nothing_else(tmp_path, capfd):
    path = tmp_path / "000000.png"
    write_image(path, np.zeros((40, 50, 3), dtype=np.uint8))
    whole = path.read_bytes()
    for content, part in [(whole[:-20], "truncated"), (b"no picture", "decoded"), (b"", "decoded")]:
        path.write_bytes(content)
        with pytest.raises(InputError) as caught:
            read_image(path)
        assert one_line_error(caught, path, part)
    path.unlink()
    with pytest.raises(InputError) as caught:
        read_image(path)
    assert one_line_error(caught, path, "missing")
    assert capfd.readouterr().err == ""


# ---------------------------------------------------------------------------- grids


def test_mask_files_are_bits_highest_first(tmp_path, grids):
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


def test_labels_are_remapped_as_the_evaluator_does():
    raw = np.array([0, 10, 252, 1, 52, 99, 81, 0], dtype=np.uint16)
    invalid = np.array([0, 0, 1, 0, 0, 0, 0, 1], dtype=bool)
    assert kitti.remap_labels(raw).tolist() == [0, 1, 1, IGNORE, IGNORE, IGNORE, 19, 0]
    expected = [0, 1, IGNORE, IGNORE, IGNORE, IGNORE, 19, IGNORE]
    assert kitti.remap_labels(raw, invalid).tolist() == expected


def test_read_labels_joins_label_and_invalid(tmp_path, grids):
    write_frame(tmp_path, "00", "000000")
    frame = find_frames(tmp_path, ["00"])[0]
    kitti.write_raw_labels(frame.voxel_file("label"), grids[0])
    kitti.write_mask(frame.voxel_file("invalid"), grids[1])
    labels = kitti.read_labels(frame)
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, kitti.remap_labels(*grids))


def test_a_prediction_file_reads_back_without_ignored_ids(tmp_path):
    labels = np.random.default_rng(2).integers(0, 20, SHAPE, dtype=np.uint8)
    path = tmp_path / "predictions" / "000000.label"
    kitti.write_labels(path, labels)
    np.testing.assert_array_equal(kitti.remap_labels(kitti.read_raw_labels(path)), labels)
    labels[0, 0, 0] = IGNORE
    with pytest.raises(ValueError, match="0-19"):
        kitti.write_labels(path, labels)


def test_unknown_raw_id_names_file_and_id(tmp_path):
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
def test_a_grid_of_the_wrong_size_gives_both_sizes(tmp_path, read, size, expected, state):
    path = tmp_path / "000000.label"
    path.write_bytes(bytes(size))
    with pytest.raises(InputError) as caught:
        read(path)
    assert one_line_error(caught, path, state, expected, f"{size:,} found")


def test_a_wrong_grid_shape_is_refused(tmp_path):
    with pytest.raises((ValueError, TypeError), match=r"shape|Type-check"):
        kitti.write_mask(tmp_path / "x.bin", np.zeros((32, 256, 256), dtype=bool))


def test_writes_are_all_or_nothing(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------------------- voxels


def test_voxel_units_and_metres_agree():
    corner = np.array(voxels.GRID_ORIGIN)
    np.testing.assert_allclose(voxels.metres_to_voxels(corner), 0, atol=1e-12)
    far = corner + voxels.GRID_SIZE
    np.testing.assert_allclose(voxels.metres_to_voxels(far), SHAPE, atol=1e-9)
    np.testing.assert_allclose(voxels.voxel_centers(np.zeros(3, int)), corner + 0.1)


def test_centers_fall_into_their_own_voxel():
    rng = np.random.default_rng(3)
    indices = rng.integers(0, SHAPE, (1000, 3))
    np.testing.assert_array_equal(voxels.points_to_indices(voxels.voxel_centers(indices)), indices)
    assert voxels.inside_grid(indices).all()
    assert not voxels.inside_grid(np.array([[-1, 0, 0], [0, 256, 0], [0, 0, 32]])).any()


def test_box_of_voxels_covers_whole_voxels():
    box = voxels.voxels_to_box(np.array([[10, 128, 10], [19, 128, 14]], dtype=np.int16))
    np.testing.assert_allclose(box, [3.0, 0.1, 0.5, 2.0, 0.2, 1.0], atol=1e-9)
