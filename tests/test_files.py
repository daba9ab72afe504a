"""Images, and atomic writes."""

import contextlib
import errno
import io
import os
import struct
import warnings
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from occdetr.errors import InputError
from occdetr.files import (
    check_folder,
    count_pictures,
    image_size_of,
    read_image,
    remove_temporary_files,
    replacing,
    write_atomically,
    write_image,
)
from scene_factory import one_line_error


def test_written_images_read_back_as_rgb(tmp_path):
    image = np.random.default_rng(1).integers(0, 256, (7, 11, 3), dtype=np.uint8)
    path = tmp_path / "fotoß" / "000000.png"
    write_image(path, image)
    np.testing.assert_array_equal(read_image(path), image)


def encoded(ending, image=None, **options):
    """An image file's bytes; by default a picture of gradients."""
    if image is None:
        y, x = np.mgrid[:60, :90]
        image = np.stack([x * 2, y * 3, x + y], -1).astype(np.uint8)
    if not isinstance(image, Image.Image):
        image = Image.fromarray(image)
    buffer = io.BytesIO()
    image.save(buffer, ending, **options)
    return buffer.getvalue()


def png_of(width, height, pixels):
    """A PNG whose header claims a size."""

    def chunk(kind, content):
        checked = kind + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(pixels)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def changed(data, start, content):
    return data[:start] + content + data[start + len(content) :]


PNG, JPEG = encoded("PNG"), encoded("JPEG", quality=95)


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (PNG[:-20], "truncated"),
        (PNG[:-12], "truncated"),
        (PNG[:8], "truncated"),
        (PNG[: len(PNG) // 2] + bytes(len(PNG) // 2), "image is"),
        (changed(PNG, len(PNG) // 2, b"\x00\xff"), "damaged"),
        (JPEG[: len(JPEG) // 2], "truncated"),
        (JPEG[:-2], "truncated"),
        (JPEG[: len(JPEG) // 2] + b"\xff\xd9", "truncated"),  # the rest would be grey
        (changed(JPEG, len(JPEG) // 2, bytes(300)), "damaged"),
        (encoded("TIFF")[:2000], "decoded"),
        (encoded("WEBP")[:200], "decoded"),
        (b"no picture", "decoded"),
        (b"", "empty"),
        (png_of(60_000, 60_000, b""), "too many pixels"),
        (png_of(20_000, 20_000, b""), "too many pixels"),
        (png_of(0, 0, b""), "decoded"),
        (png_of(200, 200, b""), "decoded"),
        (cv2.imencode(".tiff", np.ones((9, 9, 3), np.float32))[1].tobytes(), "float32"),
    ],
)
def test_broken_images_are_reported_in_one_line(content, part, tmp_path, capfd):
    path = tmp_path / "000000.png"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_image(path)
    assert one_line_error(caught, path, part)
    assert capfd.readouterr().err == ""


def test_paths_that_are_no_files_are_reported(tmp_path):
    (tmp_path / "link.png").symlink_to(tmp_path / "gone.png")
    (tmp_path / "folder.png").mkdir()
    for name, part in (("x.png", "missing"), ("link.png", "gone.png"), ("folder.png", "directory")):
        with pytest.raises(InputError) as caught:
            read_image(tmp_path / name)
        assert one_line_error(caught, tmp_path / name, part)


@pytest.mark.parametrize(
    "content",
    [
        PNG + b"bytes after the end" * 9,
        JPEG + b"\0" * 99,
        JPEG[:-2] + b"\x01\x02" + JPEG[-2:],  # as some cameras write it
        *(encoded(ending) for ending in ("WEBP", "TIFF", "GIF", "PPM", "BMP", "JPEG2000")),
        encoded("GIF", save_all=True, append_images=[Image.new("RGB", (90, 60))] * 2),
        encoded("PNG", save_all=True, append_images=[Image.new("RGB", (90, 60))] * 2),
        encoded("PNG", Image.open(io.BytesIO(PNG)).quantize(256)),
        encoded(
            "PNG",
            Image.merge(
                "RGBA", (*Image.open(io.BytesIO(PNG)).split(), Image.new("L", (90, 60), 9))
            ),
        ),
    ],
)
def test_other_forms_of_an_image_decode_to_the_same(content, tmp_path, capfd):
    """The name's ending does not matter, transparency is ignored, the first frame is taken."""
    path = tmp_path / "image.jpg"
    path.write_bytes(content)
    expected = np.array(Image.open(io.BytesIO(PNG)))
    assert np.abs(read_image(path).astype(int) - expected).mean() < 6
    assert image_size_of(path) == (60, 90)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("ending", ["PNG", "JPEG"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_turned_as_viewers_do(ending, orientation, tmp_path):
    exif = Image.Exif()
    exif[0x112] = orientation
    path = tmp_path / "image.png"
    path.write_bytes(encoded(ending, exif=exif))
    expected = np.array(ImageOps.exif_transpose(Image.open(path)))
    found = read_image(path)
    assert found.shape == expected.shape
    assert image_size_of(path) == expected.shape[:2]
    assert np.abs(found.astype(int) - expected).mean() < 3


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_deep_images_are_scaled_by_the_bits_they_use(bits, tmp_path):
    values = np.arange(256, dtype=np.uint16).repeat(3).reshape(16, 16, 3)
    path = tmp_path / "deep.png"
    path.write_bytes(cv2.imencode(".png", values[..., ::-1] << (bits - 8))[1].tobytes())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        np.testing.assert_array_equal(read_image(path), values)
    assert [f"read as {bits}-bit" in str(warning.message) for warning in caught] == [True] * (
        bits < 16
    )


def test_inks_become_colours(tmp_path):
    path = tmp_path / "inks.jpg"
    path.write_bytes(encoded("JPEG", Image.new("CMYK", (90, 60), (0, 255, 255, 0)), quality=95))
    np.testing.assert_allclose(read_image(path)[30, 40], [255, 0, 0], atol=4)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fail(*_):
        raise OSError(errno.ENOSPC, "disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_where_a_file_is_to_be_written(tmp_path):
    path = tmp_path / "predictions.json"
    path.mkdir()
    with pytest.raises(
        InputError, match=r"predictions\.json: is a folder, .*: move it away"
    ) as error:
        write_atomically(path, b"new")
    assert ".tmp" not in str(error.value)
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_of_writing_names_the_file_itself(tmp_path):
    path = tmp_path / "file"
    with pytest.raises(OSError, match="gone") as error, replacing(path) as temporary:
        raise FileNotFoundError(errno.ENOENT, "gone", str(temporary))
    assert (error.value.filename, error.value.filename2) == (str(path), None)


def test_what_a_killed_process_leaves_is_removed_and_nothing_else(tmp_path):
    with contextlib.suppress(KeyboardInterrupt), replacing(tmp_path / "last.ckpt") as temporary:
        raise KeyboardInterrupt
    others = ["last.ckpt", ".last.ckpt.tmp", f"x.{'0' * 32}.tmp", f".x.{'0' * 31}g.tmp", ".hidden"]
    for name in (*others, temporary.name):
        (tmp_path / name).touch()
    (tmp_path / f".folder.{'0' * 32}.tmp").mkdir()
    (tmp_path / f".link.{'0' * 32}.tmp").symlink_to(tmp_path / "last.ckpt")
    remove_temporary_files(tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {*others, f".folder.{'0' * 32}.tmp", f".link.{'0' * 32}.tmp"}


def test_a_file_where_a_folder_is_needed(tmp_path):
    (tmp_path / "a").touch()
    for folder in (tmp_path / "a", tmp_path / "a/b/c"):
        with pytest.raises(InputError, match=rf"^data\.x={folder}: {tmp_path}/a is a file: give a"):
            check_folder("data.x", folder)
    check_folder("data.x", tmp_path / "new/folder")


@pytest.mark.parametrize(("suffix", "number"), [("gif", 3), ("tif", 3), ("webp", 3), ("png", 1)])
def test_pictures_of_a_file_are_counted(suffix, number, tmp_path):
    frames = [Image.new("RGB", (40, 40), (50 * shade, 0, 0)) for shade in range(3)]
    more = {"save_all": True, "append_images": frames[1:]} if number > 1 else {}
    frames[0].save(tmp_path / f"a.{suffix}", **more)
    assert count_pictures(tmp_path / f"a.{suffix}") == number
