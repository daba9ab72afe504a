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
    with pytest.warns(UserWarning, match=r"000005\.png: file is missing.*08: 2 of 4"):
        frames = find_frames(tmp_path, ["08", "00", 8], stride=5, allow_partial=True)
    assert [frame.id for frame in frames] == ["08/000000", "08/000010", "00/000020"]
    assert frames[0].image == tmp_path / "sequences/08/image_2/000000.png"
    assert frames[0].voxel_file("invalid") == tmp_path / "sequences/08/voxels/000000.invalid"
    with pytest.warns(UserWarning, match="08: 3 of 5"):
        assert len(find_frames(tmp_path, ["08"], stride=1, allow_partial=True)) == 3
    assert summarize_frames(frames, 5) == "3 frames (sequences 08, 00, stride 5)"
    assert summarize_frames(frames[:1], 5) == "1 frame (sequence 08, stride 5)"


def test_sequences_may_be_numbers_as_yaml_reads_them(tmp_path):
    write_frame(tmp_path, "08", "000000")
    assert find_frames(tmp_path, [8]) == find_frames(str(tmp_path), ["08"])
    assert find_frames(tmp_path, "08") == find_frames(tmp_path, ["08"])


def test_frames_without_labels(tmp_path):
    write_frame(tmp_path, "11", "000000", kinds=("bin",))
    write_frame(tmp_path, "11", "000001", kinds=())  # no voxels are due
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


def test_scans_of_the_hidden_test_without_voxels_at_its_end_are_no_frames(tmp_path):
    for number in range(0, 25, 5):
        write_frame(tmp_path, "11", f"{number:06d}", ("bin",) if number <= 10 else ())
    (tmp_path / "sequences/11/times.txt").write_text("0.1\n" * 21)
    frames = find_frames(tmp_path, ["11"], labels=False)
    assert [frame.name for frame in frames] == ["000000", "000005", "000010"]


def damage(root, *names):
    for name in names:
        (root / "sequences/08" / name).unlink()


@pytest.mark.parametrize(
    ("lost", "stride", "labels", "part"),
    [
        (["image_2/000010.png"], 5, True, "image_2/000010.png: file is missing"),
        (["voxels/000010.label"], 5, True, "voxels/000010.label: file is missing"),
        (["voxels/000010.label"], 10, True, "(stride 10): 08: 1 of 2"),
        (["voxels/000005.invalid", "voxels/000010.label"], 1, True, "000005.invalid: file"),
        ([f"voxels/000010.{kind}" for kind in ("label", "invalid")], 5, True, "000010.label: file"),
        ([f"voxels/000015.{kind}" for kind in ("label", "invalid")], 1, True, "08: 3 of 4"),
        (["voxels/000010.bin"], 5, False, "voxels/000010.bin: file is missing"),
        (["image_2/000005.png"], 5, False, "08: 3 of 4"),
    ],
)
def test_partial_sequences_are_refused_unless_allowed(tmp_path, lost, stride, labels, part):
    """With images of every scan and voxels of every fifth."""
    for number in range(18):
        kinds = ("label", "invalid", "bin") if number % 5 == 0 else ()
        write_frame(tmp_path, "08", f"{number:06d}", kinds)
        write_frame(tmp_path, "00", f"{number:06d}", kinds)
    whole = find_frames(tmp_path, ["00", "08"], stride, labels)
    damage(tmp_path, *lost)
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, ["00", "08"], stride, labels)
    assert one_line_error(caught, part, "data.allow_partial=true")
    with pytest.warns(UserWarning, match=r"of 4|of 2"):
        found = find_frames(tmp_path, ["00", "08"], stride, labels, allow_partial=True)
    broken = {name.split("/")[1][:6] for name in lost}
    assert found == [f for f in whole if f.sequence == "00" or f.name not in broken]


@pytest.mark.parametrize("kinds", [("label", "invalid"), ()])
def test_sequences_that_end_early_are_noticed_by_their_times(tmp_path, kinds):
    for number in range(0, 10, 5):
        write_frame(tmp_path, "08", f"{number:06d}", kinds)
    times = tmp_path / "sequences/08/times.txt"
    for count in (6, 10):
        times.write_text("0.1\n" * count)
        assert len(find_frames(tmp_path, ["08"], labels=bool(kinds))) == 2
    times.write_text("0.1\n" * 21)
    with pytest.raises(InputError) as caught:
        find_frames(tmp_path, ["08"], labels=bool(kinds))
    assert one_line_error(caught, "image_2/000010.png: file is missing", "08: 2 of 5")


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
    [
        (["08"], 0, "stride=0"),
        ([], 5, "name at"),
        *(([name], 5, repr(name)) for name in ("x", "../../08", "8/..", "-8", True, "", "1_0")),
    ],
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
