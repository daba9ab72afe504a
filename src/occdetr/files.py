"""Reading images, and atomic writes."""

from __future__ import annotations

import contextlib
import json
import os
import uuid
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from occdetr.errors import InputError


def write_atomically(path: Path | str, data: bytes) -> None:
    """Write a file atomically: other processes see all of it or nothing. Makes missing folders."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:  # of a full disk it has no name
        error.filename = error.filename or str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


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


def read_bytes(path: Path | str) -> bytes:
    """The content of a file. Raises ``InputError`` if it is missing or cannot be read."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: file is missing: check the dataset folder") from None
    except OSError as error:
        raise InputError(f"{path}: file cannot be read ({error.strerror})") from None


def read_image(path: Path | str) -> UInt8[np.ndarray, "height width 3"]:
    """Read an image as RGB. Raises ``InputError`` if it is missing or cannot be decoded."""
    data = read_bytes(path)
    # libpng prints messages of its own about truncated files, so check for the end before
    complete = data[-12:].find(b"IEND") >= 0 or not data.startswith(b"\x89PNG")
    image = None
    if data and complete:
        with contextlib.suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        state = "cannot be decoded" if complete else "is truncated"
        raise InputError(f"{path}: image {state}: copy or download it again")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def write_image(path: Path | str, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an RGB image atomically, as PNG or in the format of the path's suffix."""
    ending = Path(path).suffix or ".png"
    _, data = cv2.imencode(ending, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    write_atomically(path, data.tobytes())
