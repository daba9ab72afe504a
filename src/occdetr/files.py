"""Reading files, images and texts, and atomic writes."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
import tempfile
import threading
import uuid
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from occdetr.errors import InputError

_PNG = b"\x89PNG\r\n\x1a\n"
_MAX_TEXT_BYTES = 2**20  # of a text file that holds a few settings
_MAX_EXTRANEOUS = 256  # bytes that some cameras leave before a JPEG's end marker

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{32}\.tmp")  # as ``replacing`` names them

_stderr_lock = threading.Lock()


@contextlib.contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """A path beside ``path`` for its new content, which takes its name at the end.

    Other processes see the old file or the whole new one; after an error the old one stays. Makes
    missing folders. An ``OSError`` names ``path``. Raises ``InputError`` if a folder is there.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder, a file is to be written there: move it away")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
    finally:
        temporary.unlink(missing_ok=True)


def temporary_name(path: Path) -> Path:
    """A path beside ``path`` that no other process uses, for its new content."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")


def remove_temporary_files(folder: Path) -> None:
    """Remove what killed processes have left of ``replacing``, if no other one uses the folder."""
    for file in folder.glob(".*.tmp"):
        if _TEMPORARY.fullmatch(file.name) and file.is_file() and not file.is_symlink():
            file.unlink(missing_ok=True)


def write_atomically(path: Path | str, data: bytes) -> None:
    """Write a file by ``replacing``."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_if_changed(path: Path | str, data: bytes) -> None:
    """``write_atomically``, unless the file holds ``data`` already.

    Its time of change then stays, by which caches tell whether it is the same file.
    """
    path = Path(path)
    if not path.is_file() or path.read_bytes() != data:
        write_atomically(path, data)


def write_json(path: Path | str, content: Any) -> None:
    """Write indented JSON atomically."""
    write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())


def check_folder(setting: str, folder: Path | str, writable: bool = False) -> None:
    """Raises ``InputError`` if a file is where a folder, or one that it is in, would be made.

    ``writable``: also if nothing can be written there.
    """
    for place in (Path(folder), *Path(folder).parents):
        if place.exists():
            if not place.is_dir():
                raise InputError(f"{setting}={folder}: {place} is a file: give a folder")
            if writable:
                _check_writable(setting, folder, place)
            return


def _check_writable(setting: str, folder: Path | str, place: Path) -> None:
    try:
        with tempfile.TemporaryFile(dir=place):
            return
    except OSError as error:
        reason = os.strerror(error.errno or 0).lower()
        raise InputError(
            f"{setting}={folder}: nothing can be written to {place} ({reason}): choose another"
        ) from error


def read_bytes(path: Path | str) -> bytes:
    """The content of a file. Raises ``InputError`` if it is missing or cannot be read."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        if Path(path).is_symlink():
            reason = f"link to {os.readlink(path)}, which is missing: copy the file itself"
        else:
            reason = "file is missing: check the path"
        raise InputError(f"{path}: {reason}") from None
    except OSError as error:
        raise InputError(f"{path}: file cannot be read ({error.strerror})") from None


def read_text(path: Path | str) -> list[str]:
    """The lines of a short text file in UTF-8, with any line ends, with or without a byte order
    mark. Raises ``InputError`` if it is missing or is not such a text."""
    if Path(path).exists() and not Path(path).is_file():
        raise InputError(f"{path}: is not a file: give a text file")
    data = read_bytes(path) if not _is_long(path) else b"\0"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: text in UTF-16: save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise InputError(f"{path}: is not a text file in UTF-8: give another file")
    return re.split(r"\r\n|\r|\n", text)


def _is_long(path: Path | str) -> bool:
    return os.path.isfile(path) and os.path.getsize(path) > _MAX_TEXT_BYTES


def read_image(path: Path | str) -> UInt8[np.ndarray, "height width 3"]:
    """Read an image as RGB, turned as its EXIF orientation says; transparency is ignored.

    Of several frames it is the first. 16-bit images keep their highest eight bits; those that use
    the lowest 10, 12 or 14 bits alone are read as such, with a warning. Raises ``InputError`` if
    the file is missing or broken, or larger than ``occdetr.MAX_PIXELS``.
    """
    data = read_bytes(path)
    if data.startswith(_PNG):
        check_png(data, path)
    try:
        with _stderr_caught() as messages:
            flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except cv2.error as error:
        if "MAX_IMAGE" in str(error):
            raise InputError(f"{path}: image has too many pixels: make it smaller") from None
        image = None
    if image is None or _is_corrupt_jpeg(messages):
        jpeg = data.startswith(b"\xff\xd8")
        state = "is truncated or damaged" if jpeg else "cannot be decoded" if data else "is empty"
        raise InputError(f"{path}: image {state}: copy or download it again")
    return cv2.cvtColor(_to_8_bits(image, path), cv2.COLOR_BGR2RGB)


def count_pictures(path: Path | str) -> int:
    """How many frames or pages an image file has, of which ``read_image`` reads the first."""
    with _stderr_caught(), contextlib.suppress(cv2.error):
        return max(cv2.imcount(str(path)), 1)
    return 1


def check_png(data: bytes, path: Path | str) -> tuple[int, int]:
    """The (height, width) in a PNG's header. Raises ``InputError`` if a part of the file is missing
    or damaged. Bytes after its end are allowed."""
    position, kind = len(_PNG), b""
    while kind != b"IEND":
        length = int.from_bytes(data[position : position + 4])
        kind = data[position + 4 : position + 8]
        end = position + 12 + length
        if end > len(data) or len(data) < position + 12:
            raise InputError(f"{path}: image is truncated: copy or download it again")
        content = memoryview(data)[position + 4 : end - 4]
        if zlib.crc32(content) != int.from_bytes(data[end - 4 : end]):
            raise InputError(f"{path}: image is damaged: copy or download it again")
        position = end
    return int.from_bytes(data[20:24]), int.from_bytes(data[16:20])


def image_size_of(path: Path) -> tuple[int, int]:
    """(height, width) of an image as ``read_image`` gives it; most PNGs are not decoded for it.

    Raises ``InputError`` as ``read_image``.
    """
    data = read_bytes(path)
    if data.startswith(_PNG) and b"eXIf" not in data:
        return check_png(data, path)
    height, width = read_image(path).shape[:2]
    return height, width


def _to_8_bits(
    image: Shaped[np.ndarray, "height width 3"], path: Path | str
) -> UInt8[np.ndarray, "height width 3"]:
    if image.dtype == np.uint8:
        return image
    if image.dtype != np.uint16:
        raise InputError(f"{path}: image of {image.dtype} values: convert it to 8 bits")
    used = int(image.max()).bit_length()
    depth = next(depth for depth in (8, 10, 12, 14, 16) if used <= depth)
    if depth < 16:
        warnings.warn(
            f"{path}: 16-bit image with values up to {image.max()} is read as {depth}-bit",
            stacklevel=3,
        )
    return (image >> (depth - 8)).astype(np.uint8)


def _is_corrupt_jpeg(messages: bytearray) -> bool:
    """Whether libjpeg has filled in what is missing: it only prints a line then."""
    lines = [line for line in messages.splitlines() if b"Corrupt JPEG" in line]
    for line in lines:
        count = re.search(rb"(\d+) extraneous bytes before marker 0xd9", line)
        if count is None or int(count[1]) > _MAX_EXTRANEOUS:
            return True
    return b"Premature end of JPEG" in messages


@contextlib.contextmanager
def _stderr_caught() -> Iterator[bytearray]:
    """What image libraries write to stderr meanwhile, instead of showing it to the user."""
    caught = bytearray()
    with _stderr_lock:
        if sys.stderr is not None:
            sys.stderr.flush()
        try:
            saved = os.dup(2)
        except OSError:  # there is no stderr
            yield caught
            return
        source, sink = os.pipe()
        for end in (source, sink):
            os.set_blocking(end, False)  # what does not fit is lost
        os.dup2(sink, 2)
        try:
            yield caught
        finally:
            os.dup2(saved, 2)
            with contextlib.suppress(BlockingIOError):
                caught += os.read(source, 2**16)
            for end in (saved, source, sink):
                os.close(end)


def print_error(line: str) -> None:
    """Print ``error: <line>`` to stderr, at no time when what is written there is caught."""
    with _stderr_lock:
        print(f"error: {line}", file=sys.stderr, flush=True)


def write_image(path: Path | str, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an RGB image atomically, as PNG or in the format of the path's suffix."""
    ending = Path(path).suffix or ".png"
    _, data = cv2.imencode(ending, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    write_atomically(path, data.tobytes())
