"""The frames of a dataset folder."""

import pytest

from occdetr.data.frames import choose_frames, find_frames, summarize_frames
from occdetr.errors import InputError
from scene_factory import one_line_error, write_frame


def test_complete_frames_are_found_in_order(tmp_path):
    for name in ("000010", "000000", "000005", "000007"):
        write_frame(tmp_path, "08", name)
    write_frame(tmp_path, "08", "000015", kinds=("label",))  # no .invalid
    write_frame(tmp_path, "00", "000020")
    (tmp_path / "sequences/08/image_2/000005.png").unlink()
    (tmp_path / "sequences/08/image_2/._000000.png").touch()  # left by archivers
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


def test_frames_without_labels(tmp_path):
    write_frame(tmp_path, "11", "000000", kinds=("bin",))
    write_frame(tmp_path, "11", "000001", kinds=())
    write_frame(tmp_path, "12", "000003", kinds=())  # no voxels folder: the images are the frames
    frames = find_frames(tmp_path, ["11", "12"], stride=1, labels=False)
    assert [frame.id for frame in frames] == ["11/000000", "12/000003"]
    assert frames[1].voxels is None
    with pytest.raises(InputError) as caught:
        frames[1].voxel_file("label")
    assert one_line_error(caught, "12/000003")
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, ["11"], stride=1, labels=True)
    assert one_line_error(caught, "2 image_2/*.png", "0 voxels/*.label")


def test_missing_folders_are_reported(tmp_path):
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


def test_a_stride_without_frames_is_reported_with_others(tmp_path):
    for number in (1, 2, 4, 6):
        write_frame(tmp_path, "08", f"{number:06d}")
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, ["08"], stride=5)
    assert one_line_error(caught, "stride 5", "stride 1 finds 4", "stride 2 finds 3")


@pytest.mark.parametrize(
    ("sequences", "stride", "part"),
    [(["08"], 0, "stride=0"), (["x"], 5, "'x'"), ([], 5, "name at")],
)
def test_invalid_settings_are_reported(tmp_path, sequences, stride, part):
    write_frame(tmp_path, "08", "000000")
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, sequences, stride)
    assert one_line_error(caught, part)


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("all", ["00/000000", "00/000005", "01/000000"]),
        (2, ["00/000000", "00/000005"]),
        ("01/000000, 00/000005", ["01/000000", "00/000005"]),
        (["01/000000"], ["01/000000"]),
    ],
)
def test_frames_are_chosen_by_number_or_name(tmp_path, wanted, expected):
    for sequence, name in (("00", "000000"), ("00", "000005"), ("01", "000000")):
        write_frame(tmp_path, sequence, name)
    frames = find_frames(tmp_path, ["00", "01"])
    assert [frame.id for frame in choose_frames(frames, wanted, "here")] == expected
    with pytest.raises(InputError) as caught:
        choose_frames(frames, "02/000000", "here")
    assert one_line_error(caught, "frames=02/000000", "here", "00/000000 to 000005 (2)")
