"""Wrong levels of a data set's root."""

from pathlib import Path

import pytest

from occdetr.data.find_root import nearby_roots, sequences_folder
from occdetr.data.frames import find_frames
from occdetr.errors import InputError
from scene_factory import one_line_error, write_frame


@pytest.mark.parametrize(
    ("holder", "given", "right"),
    [
        ("kitti", "kitti/sequences", "kitti"),
        ("kitti", "kitti/sequences/00", "kitti"),
        ("kitti", ".", "kitti"),
        ("kitti/dataset", "kitti", "kitti/dataset"),
        ("kitti/a/b", "kitti", "kitti/a/b"),
        ("kitti/sequences", "kitti", "kitti/sequences"),
    ],
)
def test_the_right_root_is_named(tmp_path, holder, given, right):
    write_frame(tmp_path / holder, "00", "000000")
    write_frame(tmp_path / "kitti/__MACOSX", "00", "000000")
    for read in (sequences_folder, lambda root: find_frames(root, ["00"])):
        with pytest.raises(InputError) as caught:
            read(tmp_path / given)
        assert one_line_error(caught, f"{tmp_path / given}: ", f"data.root={tmp_path / right}")
        assert str(caught.value).endswith(f"data.root={tmp_path / right}")


def test_relative_roots(tmp_path, monkeypatch):
    write_frame(tmp_path / "kitti", "00", "000000")
    monkeypatch.chdir(tmp_path / "kitti/sequences")
    assert nearby_roots(Path()) == nearby_roots(Path("00")) == [Path("..")]
    monkeypatch.chdir(tmp_path)
    assert nearby_roots(Path("kitti/sequences")) == [Path("kitti")]
    assert sequences_folder(Path("kitti")) == Path("kitti/sequences")


def test_sequences_without_their_folder_and_no_data(tmp_path):
    write_frame(tmp_path, "00", "000000")
    (tmp_path / "sequences").rename(tmp_path / "mine")
    with pytest.raises(InputError) as caught:
        sequences_folder(tmp_path / "mine")
    assert one_line_error(caught, "00", f"into {tmp_path / 'mine/sequences'}")
    with pytest.raises(InputError) as caught:
        sequences_folder(tmp_path / "nowhere")
    assert one_line_error(caught, "no such folder", "data.root")
    (tmp_path / "empty/sequences").mkdir(parents=True)
    assert sequences_folder(tmp_path / "empty") == tmp_path / "empty/sequences"
