"""A generator of malformed inputs: pictures, calibrations, voxel files and folders of data sets.

Each case writes its files and names the entry point that must refuse them: in one line for each
error on stderr, with one of the case's exit codes, without a traceback and with nothing half
written.
"""

from __future__ import annotations

import functools
import io
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

from model_factory import tiny_config, tiny_model
from occdetr.geometry.kitti import kitti_camera, write_calibration

#: Height and width of the pictures.
SIZE = (64, 208)
FRAMES = ("000000", "000005")  # the frames of a sequence


@dataclass(frozen=True)
class Malformed:
    """One malformed input.

    ``make`` writes its files below a folder and returns the overrides for the entry point
    ``command``, which must end with one of ``codes``. ``kind`` groups the cases in tables.
    """

    name: str
    kind: str
    command: str
    make: Callable[[Path], list[str]]
    codes: tuple[int, ...] = (2,)


def malformed_inputs() -> list[Malformed]:
    """Every case; the names differ."""
    return [*_pictures(), *_mixed_pictures(), *_names(), *_calibrations(), *_data_sets()]


def setting(key: str, value: object) -> str:
    """An override, quoted for Hydra."""
    quoted = str(value).replace("\\", "\\\\").replace("'", "\\'")
    return f"{key}='{quoted}'"


def changed(data: bytes, start: int, content: bytes) -> bytes:
    """``data`` with other bytes from ``start`` on, and as long as before."""
    return data[:start] + content + data[start + len(content) :]


# pictures


@functools.cache
def picture(ending: str = "PNG", size: tuple[int, int] = SIZE) -> bytes:
    """An image file of gradients."""
    y, x = np.mgrid[: size[0], : size[1]]
    buffer = io.BytesIO()
    Image.fromarray(np.stack([x, y * 3, x + y], -1).astype(np.uint8)).save(buffer, ending)
    return buffer.getvalue()


def png(width: int, height: int, pixels: bytes = b"", depth: int = 8, color: int = 2) -> bytes:
    """A PNG with a header of choice, and checksums that fit."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(pixels)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def broken_pictures() -> dict[str, bytes]:
    """The contents of image files that cannot be used, by what is wrong."""
    whole, jpeg = picture(), picture("JPEG")
    half, middle = len(jpeg) // 2, len(whole) // 2
    floats = cv2.imencode(".tiff", np.ones((*SIZE, 3), np.float32))[1].tobytes()
    turned = io.BytesIO()
    exif = Image.Exif()
    exif[0x112] = 6
    Image.open(io.BytesIO(jpeg)).save(turned, "JPEG", exif=exif)
    return {
        "empty": b"",
        "one byte": b"\x89",
        "text": b"this is no picture\n",
        "page instead of the image": b"<!DOCTYPE html><html>404</html>",
        "archive": b"PK\x03\x04" + bytes(300),
        "zeros": bytes(5000),
        "png without its end": whole[:-12],
        "png cut in the middle": whole[:middle],
        "png with only its signature": whole[:8],
        "png with a cut header": whole[:20],
        "png with zeros for its second half": whole[:middle] + bytes(len(whole) - middle),
        "png with a changed byte": changed(whole, middle, bytes([whole[middle] ^ 1])),
        "png without pixels": png(SIZE[1], SIZE[0]),
        "png with too few pixels": png(SIZE[1], SIZE[0], bytes(100)),
        "png of no size": png(0, 0),
        "png that claims 60,000 x 60,000": png(60_000, 60_000),
        "png that claims 30,000 x 30,000": png(30_000, 30_000),
        "png with an unknown colour type": png(SIZE[1], SIZE[0], bytes(40_000), color=5),
        "jpeg cut in the middle": jpeg[:half],
        "jpeg without its end": jpeg[:-2],
        "jpeg cut, with an end": jpeg[:half] + b"\xff\xd9",
        "jpeg with a hole": changed(jpeg, half, bytes(200)),
        "jpeg with only its signature": jpeg[:4],
        "webp cut in the middle": picture("WEBP")[:60],
        "tiff cut in the middle": picture("TIFF")[:5000],
        "gif cut in the middle": picture("GIF")[:900],
        "bmp cut in the middle": picture("BMP")[:5000],
        "tiff of floats": floats,
        "1 x 1": picture(size=(1, 1)),
        "8 x 26": picture(size=(8, 26)),
        "twice the size": picture(size=(128, 416)),
        "one column less": picture(size=(SIZE[0], SIZE[1] - 1)),
        "turned by its orientation": turned.getvalue(),
    }


def predict_settings(folder: Path, images: object, calib: str | bytes | None = None) -> list[str]:
    """Overrides for ``predict``, with a calibration that fits ``picture()`` if none is given."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "calib.txt"
    if calib is None:
        write_calibration(path, kitti_camera(SIZE))
    else:
        path.write_bytes(calib if isinstance(calib, bytes) else calib.encode())
    given = {"checkpoint": "none.ckpt", "images": images, "calib": path}
    words = [setting(key, value) for key, value in given.items()]
    return [*words, setting("hydra.run.dir", folder / "run"), "device=cpu"]


def one_picture(content: bytes, folder: Path) -> list[str]:
    path = folder / "photos/picture.png"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    return predict_settings(folder, path)


def _pictures() -> list[Malformed]:
    return [
        Malformed(f"picture: {name}", "picture", "predict", functools.partial(one_picture, content))
        for name, content in broken_pictures().items()
    ]


@functools.cache
def checkpoint() -> bytes:
    """A checkpoint of an untrained network."""
    model, buffer = tiny_model().state_dict(), io.BytesIO()
    content = {
        "occdetr": {"stage": "full", "version": "0.1.0"},
        "hyper_parameters": _plain(tiny_config()),
        "state_dict": {f"model.{name}": value for name, value in model.items()},
    }
    torch.save(content, buffer)
    return buffer.getvalue()


def _plain(config: object) -> object:
    from omegaconf import OmegaConf

    model = OmegaConf.to_container(config.model, resolve=True)  # pyright: ignore
    return {"model": model}


def good_and_broken(contents: list[bytes], folder: Path) -> list[str]:
    (folder / "photos").mkdir(parents=True)
    for number, content in enumerate(contents):
        (folder / f"photos/{number}.png").write_bytes(content)
    words = predict_settings(folder, folder / "photos")
    (folder / "network.ckpt").write_bytes(checkpoint())
    return [setting("checkpoint", folder / "network.ckpt"), *words[1:]]


def _mixed_pictures() -> list[Malformed]:
    broken = broken_pictures()
    cases = {
        "one of two broken": ([picture(), broken["png cut in the middle"]], (3,)),
        "one of two of another size": ([broken["twice the size"], picture()], (3,)),
        "two of two broken": ([broken["empty"], broken["jpeg with a hole"]], (2,)),
    }
    return [
        Malformed(
            f"pictures: {name}",
            "pictures among others",
            "predict",
            functools.partial(good_and_broken, contents),
            codes,
        )
        for name, (contents, codes) in cases.items()
    ]


# names and places of pictures


def no_folder(folder: Path) -> list[str]:
    return predict_settings(folder, folder / "photos")


def photos(names: tuple[str, ...], folder: Path) -> list[str]:
    """A folder of the same picture under several names."""
    (folder / "photos").mkdir(parents=True)
    for name in names:
        (folder / "photos" / name).write_bytes(picture())
    return predict_settings(folder, folder / "photos")


def folder_called_png(folder: Path) -> list[str]:
    (folder / "photos/x.png").mkdir(parents=True)
    return predict_settings(folder, folder / "photos/x.png")


def broken_link(folder: Path) -> list[str]:
    words = photos((), folder)
    (folder / "photos/x.png").symlink_to(folder / "gone.png")
    return words


def link_to_itself(folder: Path) -> list[str]:
    (folder / "photos").mkdir(parents=True)
    (folder / "photos/x.png").symlink_to(folder / "photos/x.png")
    return predict_settings(folder, folder / "photos/x.png")


def pipe(folder: Path) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    os.mkfifo(folder / "x.png")
    return predict_settings(folder, folder / "x.png")


def in_the_run_folder(folder: Path) -> list[str]:
    (folder / "run").mkdir(parents=True)
    (folder / "run/x.png").write_bytes(picture())
    return predict_settings(folder, folder / "run")


def newline_in_a_name(folder: Path) -> list[str]:
    (folder / "photos").mkdir(parents=True)
    (folder / "photos/a\nb.png").write_bytes(b"")
    return predict_settings(folder, folder / "photos")


def long_pattern(folder: Path) -> list[str]:
    return predict_settings(folder, "x" * 5000)


def calibration_is_a_folder(folder: Path) -> list[str]:
    words = one_picture(picture(), folder)
    (folder / "calib.txt").unlink()
    (folder / "calib.txt").mkdir()
    return words


def calibration_is_missing(folder: Path) -> list[str]:
    words = one_picture(picture(), folder)
    (folder / "calib.txt").unlink()
    return words


def _names() -> list[Malformed]:
    makers = (
        *(no_folder, folder_called_png, broken_link, link_to_itself, pipe, in_the_run_folder),
        *(newline_in_a_name, long_pattern, calibration_is_a_folder, calibration_is_missing),
    )
    folders = {
        "empty folder": (),
        "other files": ("a.heic", "._b.png", ".hidden.png", "notes.txt"),
        "equal names": ("IMG.png", "img.jpg"),
    }
    cases = {make.__name__.replace("_", " "): make for make in makers}
    cases |= {name: functools.partial(photos, files) for name, files in folders.items()}
    return [Malformed(f"path: {name}", "path", "predict", make) for name, make in cases.items()]


# calibrations

P2 = "P2: 120 0 104 7 0 120 32 0.1 0 0 1 0.005"
TR = "Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27"


def broken_calibrations() -> dict[str, str | bytes]:
    """Texts that are no calibration of ``picture()``, by what is wrong."""
    both = f"{P2}\n{TR}\n"
    return {
        "empty": "",
        "blank lines": "\n\n\r\n",
        "without P2": f"{TR}\n",
        "without Tr": f"{P2}\n",
        "without colon": both.replace("P2:", "P2"),
        "names in small letters": both.lower(),
        "P2 twice": f"{both}{P2}\n",
        "Tr twice, differing": f"{both}{TR.replace('0.27', '0.28')}\n",
        "eleven numbers": both.replace(" 0.005", ""),
        "thirteen numbers": both.replace(" 0.005", " 0.005 1"),
        "no number": both.replace("-0.27", ""),
        "a matrix of three lines": both.replace(" 7 0 120", " 7\n0 120"),
        "decimal commas": both.replace("0.27", "0,27"),
        "commas between numbers": both.replace(" 0 ", ", 0, "),
        "nan": both.replace("120 32", "nan 32"),
        "infinity": both.replace("104", "inf"),
        "overflow": both.replace("104", "1e400"),
        "underscores": both.replace("104", "1_04"),
        "hexadecimal": both.replace("104", "0x68"),
        "words": both.replace("104", "cx"),
        "no focal length": both.replace("120", "0"),
        "focal lengths of no camera": both.replace("P2: 120", "P2: 1e30"),
        "negative focal length": both.replace("P2: 120", "P2: -120"),
        "singular P2": both.replace("0 0 1 0.005", "0 0 0 0"),
        "P2 of zeros": f"P2:{' 0' * 12}\n{TR}",
        "P2 scaled": both.replace("0 0 1 0.005", "0 0 2 0.01"),
        "Tr of zeros": f"{P2}\nTr:{' 0' * 12}",
        "Tr not orthogonal": both.replace("0 0 -1 -0.08", "0 0.3 -1 -0.08"),
        "Tr with a scale": both.replace("1 0 0 -0.27", "1.1 0 0 -0.27"),
        "Tr mirrored": both.replace("Tr: 0 -1", "Tr: 0 1"),
        "Tr inverted": f"{P2}\nTr: 0 0 1 0.27 -1 0 0 0 0 -1 0 -0.08",
        "Tr in millimetres": both.replace("-0.27", "-270"),
        "size of another picture": f"{both}size: 1226 370\n",
        "size in words": f"{both}size: large\n",
        "size with one number": f"{both}size: 208\n",
        "size of zero": f"{both}size: 0 0\n",
        "principal point outside": both.replace("104", "1040"),
        "UTF-16": both.encode("utf-16"),
        "UTF-16 without its mark": both.encode("utf-16-le"),
        "UTF-32": both.encode("utf-32"),
        "Latin-1 with umlauts": f"Höhe: 1\n{both}".encode("latin-1"),
        "bytes of an image": picture(),
        "zeros": bytes(400),
        "ten megabytes": b"# filler\n" * 1_200_000,
        "JSON": '{"P2": [1, 2, 3]}',
    }


def one_calibration(content: str | bytes, folder: Path) -> list[str]:
    one_picture(picture(), folder)
    return predict_settings(folder, folder / "photos/picture.png", content)


def _calibrations() -> list[Malformed]:
    return [
        Malformed(
            f"calibration: {name}",
            "calibration",
            "predict",
            functools.partial(one_calibration, content),
        )
        for name, content in broken_calibrations().items()
    ]


# data sets

GRID_BYTES = {"label": 4_194_304, "invalid": 262_144, "bin": 262_144, "occluded": 262_144}


def data_set(damage: Callable[[Path], object], folder: Path) -> list[str]:
    """Overrides for ``prepare`` or ``visualize`` with an empty data set that is then damaged.

    ``damage`` gets the folder of its first sequence, and may return further overrides.
    """
    root = folder / "data"
    for sequence in ("00", "08"):
        path = root / "sequences" / sequence
        for part in ("image_2", "voxels"):
            (path / part).mkdir(parents=True)
        write_calibration(path / "calib.txt", kitti_camera(SIZE))
        for name in FRAMES:
            (path / f"image_2/{name}.png").write_bytes(picture())
            for kind, size in GRID_BYTES.items():
                with (path / f"voxels/{name}.{kind}").open("wb") as file:
                    file.truncate(size)  # zeros
    more = damage(root / "sequences/00")
    return [
        *("data=semantickitti", setting("data.root", root), "data.train_sequences=[0]"),
        setting("data.cache_dir", folder / "cache"),
        setting("hydra.run.dir", folder / "run"),
        *(more if isinstance(more, list) else []),
    ]


def overwrite(name: str, content: bytes, sequence: Path) -> None:
    (sequence / name).write_bytes(content)


def resize(name: str, size: int, sequence: Path) -> None:
    os.truncate(sequence / name, size)


def remove(name: str, sequence: Path) -> None:
    (sequence / name).unlink()


def replace_with_folder(name: str, sequence: Path) -> None:
    (sequence / name).unlink()
    (sequence / name).mkdir()


def remove_folder(name: str, sequence: Path) -> None:
    for file in (sequence / name).iterdir():
        file.unlink()
    (sequence / name).rmdir()


def rename(name: str, new: str, sequence: Path) -> None:
    (sequence / name).rename(sequence / new)


def more_scans(sequence: Path) -> None:
    (sequence / "times.txt").write_text("0.1\n" * 30)


def settings(*words: str) -> Callable[[Path], list[str]]:
    return lambda sequence: list(words)


def damages() -> dict[str, Callable[[Path], object]]:
    """What makes a data set unusable, by its description."""
    part = functools.partial
    label, invalid, image = "voxels/000000.label", "voxels/000000.invalid", "image_2/000000.png"
    unknown_id = struct.pack("<H", 77) + bytes(GRID_BYTES["label"] - 2)
    return {
        "label of a byte less": part(resize, label, GRID_BYTES["label"] - 1),
        "label of a byte more": part(resize, label, GRID_BYTES["label"] + 1),
        "label twice as large": part(resize, label, 2 * GRID_BYTES["label"]),
        "label of one byte per voxel": part(resize, label, GRID_BYTES["label"] // 2),
        "empty label": part(resize, label, 0),
        "label with an unknown id": part(overwrite, label, unknown_id),
        "label that is a folder": part(replace_with_folder, label),
        "empty label of a full scan": part(
            overwrite, "voxels/000000.bin", b"\x80" * GRID_BYTES["bin"]
        ),
        "label that is text": part(overwrite, label, b"0 0 0\n"),
        "invalid of a byte less": part(resize, invalid, GRID_BYTES["invalid"] - 1),
        "invalid of a byte per voxel": part(resize, invalid, 8 * GRID_BYTES["invalid"]),
        "empty invalid": part(resize, invalid, 0),
        "invalid that is a folder": part(replace_with_folder, invalid),
        "no label": part(remove, label),
        "no invalid": part(remove, invalid),
        "no image": part(remove, image),
        "no label of the last frame": part(remove, "voxels/000005.label"),
        "no image folder": part(remove_folder, "image_2"),
        "no voxels folder": part(remove_folder, "voxels"),
        "sequence that ends early": more_scans,
        "no calibration": part(remove, "calib.txt"),
        "calibration that is a folder": part(replace_with_folder, "calib.txt"),
        "empty calibration": part(overwrite, "calib.txt", b""),
        "calibration of another picture": part(
            overwrite, "calib.txt", f"{P2}\n{TR}\nsize: 1226 370".encode()
        ),
        "images called otherwise": part(rename, image, "image_2/first.png"),
        "truncated image": part(overwrite, image, picture()[:-40]),
        "image of another size": part(overwrite, image, picture(size=(128, 416))),
        "empty image": part(overwrite, image, b""),
        "image that is a folder": part(replace_with_folder, image),
        "sequence that is missing": settings("data.train_sequences=[3]"),
        "sequence outside": settings("data.train_sequences=['../../x']"),
        "sequence of words": settings("data.train_sequences=[first]"),
        "no sequences": settings("data.train_sequences=[]"),
        "stride without frames": settings("data.stride=0"),
        "root that is missing": settings("data.root=nowhere"),
    }


def _data_sets() -> list[Malformed]:
    cases = [
        Malformed(
            f"data set: {name}",
            "voxels" if "label of" in name or "invalid" in name else "data set",
            "prepare",
            functools.partial(_prepared, damage),
        )
        for name, damage in damages().items()
    ]
    drawn = {
        "frame that is missing": settings("frames='00/000003'"),
        "frame outside": settings("frames='../../x'"),
        "jpeg with a hole": functools.partial(
            overwrite, "image_2/000000.png", broken_pictures()["jpeg with a hole"]
        ),
    }
    return cases + [
        Malformed(
            f"pictures of labels: {name}",
            "data set",
            "visualize",
            functools.partial(data_set, damage),
        )
        for name, damage in drawn.items()
    ]


def _prepared(damage: Callable[[Path], object], folder: Path) -> list[str]:
    return [*data_set(damage, folder), "workers=1"]
