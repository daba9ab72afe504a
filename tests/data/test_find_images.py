"""Image files that the user names, and the names of what is written for them."""

import os
from pathlib import Path

import pytest

from occdetr.data.find_images import find_images, output_names
from occdetr.errors import InputError
from scene_factory import one_line_error


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_other_files_of_a_folder_are_counted(tmp_path):
    names = ["b.png", "a.JPG", "c.webp", "d.tif", "e.gif", "f.ppm", "g.avif"]
    touch(tmp_path, *names, "._b.png", ".DS_Store", "x.heic", "y.heic", "notes", "more/z.png")
    (tmp_path / "link.png").symlink_to(tmp_path / "gone.png")
    (tmp_path / "folder.png").mkdir()
    os.mkfifo(tmp_path / "pipe.png")
    images, skipped = find_images(str(tmp_path))
    assert [image.name for image in images] == sorted([*names, "link.png"])
    assert skipped.endswith("2 .heic, 2 folder, 2 hidden, 1 special file, 1 without suffix")
    images, skipped = find_images(f"{tmp_path}/[bx]*")
    assert [image.name for image in images] == ["b.png"]
    assert skipped.endswith("1 .heic")
    assert find_images(f"{tmp_path}/**/z.png") == ([tmp_path / "more/z.png"], "")


@pytest.mark.parametrize(
    "name",
    ["a b.png", "straße ü.png", "街.png", "x(1).png", "x[1].png", "x*.png", "a\nb.png", "x.txt"],
)
def test_a_file_that_exists_is_meant_itself(tmp_path, name):
    touch(tmp_path, name, "x1.png", "xy.png")
    assert find_images(str(tmp_path / name)) == ([tmp_path / name], "")


def test_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    touch(tmp_path, "photos/x.png")
    for pattern in ("~/photos", "~/photos/x.png", "~/ph*/x*"):
        assert find_images(pattern) == ([tmp_path / "photos/x.png"], "")


@pytest.mark.parametrize("pattern", ["gone.png", "*.png", "", "~nobody-here/x.png", "x" * 5000])
def test_no_image_is_reported(tmp_path, monkeypatch, pattern):
    monkeypatch.chdir(tmp_path)
    touch(tmp_path, "x.heic")
    with pytest.raises(InputError) as caught:
        find_images(pattern)
    assert one_line_error(caught, f"images={pattern}: no image there")
    assert "a single video file" in str(caught.value)
    assert ("skipped what is no image: 1 .heic" in str(caught.value)) == (pattern == "")


def test_names_of_outputs_are_those_of_the_images(tmp_path):
    images = [tmp_path / name for name in ("a.png", "b.c.jpg", "predictions.png", "straße.png")]
    assert output_names(images, tmp_path / "run") == ["a", "b.c", "predictions", "straße"]


@pytest.mark.parametrize(
    "name",
    [
        "a\nb.png",
        "a\\b.png",
        "x" * 250 + ".png",
        "街" * 80 + ".png",
        "\udcff.png",
        "...png",
        "..png",
    ],
)
def test_outputs_stay_in_their_folder_whatever_the_image_is_called(tmp_path, name):
    (output,) = output_names([Path("photos") / name], tmp_path)
    assert (tmp_path / f"{output}.label").resolve().parent == tmp_path.resolve()
    assert not set(output) & {"\n", "/", "\\"}
    (tmp_path / f".{output}.label.{'0' * 32}.tmp").touch()  # as written
    assert output_names([Path(f"photos/{'x' * 200}{end}.png") for end in "ab"], tmp_path)


@pytest.mark.parametrize(
    ("first", "second"),
    [("a.png", "a.jpg"), ("IMG.png", "img.png"), ("ü.png", "u\u0308.png"), ("a\n.png", "a_.png")],
)
def test_equal_names_are_refused(tmp_path, first, second):
    with pytest.raises(InputError, match="same name"):
        output_names([Path(first), Path(second)], tmp_path)


def test_images_in_the_folder_of_the_results_are_refused(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(InputError) as caught:
        output_names([tmp_path / "link" / "x.png"], tmp_path)
    assert one_line_error(caught, "x.png", "hydra.run.dir")
