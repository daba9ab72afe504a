"""Images, and atomic writes."""

import os

import numpy as np
import pytest

from occdetr.errors import InputError
from occdetr.files import read_image, write_atomically, write_image
from scene_factory import one_line_error


def test_written_images_read_back_as_rgb(tmp_path):
    image = np.random.default_rng(1).integers(0, 256, (7, 11, 3), dtype=np.uint8)
    path = tmp_path / "fotoß" / "000000.png"
    write_image(path, image)
    np.testing.assert_array_equal(read_image(path), image)


def test_unreadable_images_are_reported_in_one_line(tmp_path, capfd):
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


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
