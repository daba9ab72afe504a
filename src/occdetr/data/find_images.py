"""Image files that the user names, and the names of what is written for them."""

from __future__ import annotations

import glob
import hashlib
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from occdetr.errors import InputError

#: Image files among others, by their suffix in lower case.
SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".bmp", ".webp", ".tif", ".tiff", ".gif", ".avif", ".jp2"),
    *(".ppm", ".pgm", ".pbm", ".pnm"),
)

_LONGEST_NAME = 180  # bytes, of at most 255 with the suffixes of temporary files


def find_images(pattern: str) -> tuple[list[Path], str]:
    """The images that a file, a folder or a glob pattern means, sorted, and which other files of
    the folder or pattern are skipped, in one line (empty if there are none).

    A file that exists is meant itself, whatever characters its name has. Raises ``InputError`` if
    there is no image.
    """
    try:
        path = Path(pattern).expanduser()
    except RuntimeError:  # no such user
        path = Path(pattern)
    if os.path.isdir(path):
        files = list(path.iterdir())
    elif os.path.isfile(path) or os.path.islink(path):
        return [path], ""
    else:
        files = [Path(file) for file in glob.glob(str(path), recursive=True)]
    reasons = {file: _reason_to_skip(file) for file in sorted(files)}
    images = [file for file, reason in reasons.items() if reason is None]
    counts = Counter(reason for reason in reasons.values() if reason is not None)
    skipped = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
    skipped = f"skipped what is no image: {skipped}" if skipped else ""
    if not images:
        raise InputError(
            f"images={pattern}: no image there{' (' if skipped else ''}{skipped}"
            f"{')' if skipped else ''}: give a file, a folder with {', '.join(SUFFIXES)} files, "
            "a quoted pattern, or a single video file"
        )
    return images, skipped


def _reason_to_skip(file: Path) -> str | None:
    """Why a file of a folder is not taken for an image; None if it is. Broken links are taken, so
    that they are reported."""
    if os.path.isdir(file):
        return "folder"
    if not os.path.isfile(file) and not os.path.islink(file):
        return "special file"
    if file.name.startswith("."):
        return "hidden"
    return None if file.suffix.lower() in SUFFIXES else file.suffix.lower() or "without suffix"


def output_names(images: Sequence[Path], folder: Path) -> list[str]:
    """For each image the name, without suffix, of what is written for it to ``folder``.

    It is the image's own, without control characters and shortened if it is too long. Raises
    ``InputError`` if two images have the same name, also where capitals do not count, or if an
    image lies in ``folder``, where it could be overwritten.
    """
    names, seen = [], {}
    for image in images:
        name = _output_name(image.stem)
        key = unicodedata.normalize("NFC", name).casefold()
        if key in seen:
            raise InputError(
                f"{seen[key]} and {image} have the same name without suffix: "
                "predict them one at a time"
            )
        if os.path.dirname(os.path.realpath(image)) == os.path.realpath(folder):
            raise InputError(
                f"{image}: lies in the folder of the results, which could overwrite it: "
                "set another hydra.run.dir"
            )
        seen[key] = image
        names.append(name)
    return names


def _output_name(stem: str) -> str:
    name = re.sub(r"[\x00-\x1f\x7f/\\]", "_", stem.encode("utf-8", "replace").decode())
    encoded = name.encode()
    if len(encoded) <= _LONGEST_NAME:
        return name
    digest = hashlib.sha256(encoded).hexdigest()[:8]
    return f"{encoded[:_LONGEST_NAME].decode(errors='ignore')}-{digest}"
