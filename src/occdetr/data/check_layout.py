"""The folders of a data set, checked without opening their files: what is there, what is not."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from occdetr.data.find_root import nearby_roots, sequence_folders
from occdetr.data.findings import ERROR, NOTE, Finding
from occdetr.data.frames import (
    LABELLED_SPLITS,
    VOXEL_STRIDE,
)
from occdetr.data.listing import FILES, Listing
from occdetr.errors import InputError
from occdetr.geometry.kitti import read_calibration

#: Parts of a sequence, and the archive that holds each.
ARCHIVES = {
    "image_2": ("data_odometry_color.zip", "KITTI's odometry benchmark"),
    "voxels": ("data_odometry_voxels.zip", "semantic-kitti.org"),
    "calib.txt": ("data_odometry_calib.zip", "KITTI's odometry benchmark"),
}
_ARCHIVE_SUFFIXES = (".zip", ".tar", ".gz", ".tgz", ".xz", ".bz2", ".7z", ".rar")
_LEFTOVERS = (".DS_Store", "__MACOSX")
_OTHER_IMAGES = {
    "image_3": "the right color camera's",
    "image_0": "the left gray camera's",
    "image_1": "the right gray camera's",
}
_LINES = ("times.txt", "poses.txt")


def check_sequence(listing: Listing, allow_partial: bool) -> Iterator[Finding]:
    """What is missing or odd in the folder of a sequence."""
    yield from _check_calibration(listing)
    yield from _check_folders(listing)
    if listing.found["image_2"] and (listing.voxel_names or len(listing.needed) == 1):
        yield from _check_numbers(listing)
        yield from _check_frames(listing, NOTE if allow_partial and listing.complete else ERROR)
    yield from _check_lines(listing)


def check_folders(
    root: Path, listings: Sequence[Listing], uses: Mapping[str, str]
) -> Iterator[Finding]:
    """What is odd in the data set as a whole: archives, files of macOS, parts in other folders.

    ``uses`` are the splits of the sequences by their names.
    """
    sequences = root / "sequences"
    for folder in (root, sequences, *(sequences / each.name for each in listings)):
        sequence = folder.name if folder.parent == sequences else None
        for name in _entries(folder):
            file = (folder / name).relative_to(root).as_posix()
            if name.endswith(_ARCHIVE_SUFFIXES):
                message = f"{(root / file).lstat().st_size:,} bytes"
                yield Finding("archives", sequence, file, message, NOTE)
            elif _is_leftover(name):
                yield Finding("leftovers", sequence, file, "left by macOS", NOTE)
    for listing in listings:
        for part in sorted({Path(file).parent.name for file in FILES.values()}):
            yield from _check_names(root, listing, part)
    yield from _check_elsewhere(root, uses)


def _check_calibration(listing: Listing) -> Iterator[Finding]:
    path, file = listing.path / "calib.txt", f"sequences/{listing.name}/calib.txt"
    if not path.exists():
        yield Finding("no-calib", listing.name, file, "file is missing")
        return
    try:
        size = read_calibration(path).image_size
    except InputError as error:
        yield Finding("calib", listing.name, file, str(error).removeprefix(f"{path}: "))
    else:
        if size is None:
            message = "an image of another size cannot be noticed"
            yield Finding("camera", listing.name, file, message, NOTE)


def _check_folders(listing: Listing) -> Iterator[Finding]:
    """Kinds of files of which there is none."""
    for file, names in listing.needed.items():
        if names:
            continue
        part = file.parent.name
        place = f"sequences/{listing.name}/{part}/*{file.suffix}"
        others = _others(listing.path, part)
        message = f"there is none{f', only {others}' if others else ''}"
        kind = "no-images" if part == "image_2" else "no-voxels"
        yield Finding(kind, listing.name, place, message)


def _others(path: Path, part: str) -> str:
    """What lies in the place of a part of a sequence: other files, or other cameras' images."""
    suffixes = {Path(name).suffix for name in _entries(path / part) if not _is_leftover(name)}
    others = [f"{part}/*{suffix}" for suffix in sorted(suffixes)]
    if part == "image_2":
        others += [
            f"{name} ({whose})" for name, whose in _OTHER_IMAGES.items() if (path / name).is_dir()
        ]
    return ", ".join(others)


def _check_numbers(listing: Listing) -> Iterator[Finding]:
    """The numbers of the files: those of voxels must be those of their images."""
    yield from _check_digits(listing)
    numbers = sorted(map(int, listing.voxel_names))
    scans = max(map(int, listing.found["image_2"])) + 1
    place = f"sequences/{listing.name}/voxels"
    every_fifth = math.ceil(scans / VOXEL_STRIDE)
    if 1 < len(numbers) == every_fifth and numbers[-1] == every_fifth - 1:
        message = f"numbered 0 to {numbers[-1]} for {scans} scans, of which every fifth has voxels"
        yield Finding("numbers", listing.name, place, message)
        return
    whole = listing.whole
    if whole and not listing.complete:
        first = min(whole, key=int)
        message = f"data.stride={listing.stride} takes none of {len(whole)} frames from {first} on"
        yield Finding("stride", listing.name, place, message)
    elif numbers and len(listing.complete) < len(whole):
        step = math.gcd(*numbers)
        message = (
            f"data.stride={listing.stride} takes {len(listing.complete)} of {len(whole)} frames "
            f"(voxels are of every {'' if step == 1 else f'{step}th '}scan)"
        )
        yield Finding("other-stride", listing.name, place, message, NOTE)


def _check_digits(listing: Listing) -> Iterator[Finding]:
    """Frames whose names have different numbers of digits, as in KITTI's raw recordings."""
    by_length = {len(name): name for name in listing.found["image_2"] | listing.voxel_names}
    if len(by_length) > 1:
        message = f"names of images and voxels as {' and '.join(sorted(by_length.values()))}"
        level = NOTE if listing.complete else ERROR
        yield Finding("names", listing.name, f"sequences/{listing.name}", message, level)


def _check_frames(listing: Listing, level: str) -> Iterator[Finding]:
    """Frames of which only some files are there, and the last ones if they have no voxels."""
    image, *voxels = listing.needed
    hint = "" if listing.labelled else " (predict then needs data.allow_partial=true)"
    last = max(map(int, listing.voxel_names), default=math.inf)
    images = listing.needed[image]
    without = [name for name in listing.expected if int(name) > last and name in images]
    if without:
        file = voxels[0].with_name(voxels[0].name.format(without[0]))
        message = f"none after {last:06d}, images up to {without[-1]}{hint}"
        yield Finding("end", listing.name, _relative(listing, file), message, level)
    for name in sorted(set(listing.expected) - set(without), key=int):
        for file, names in listing.needed.items():
            if names and name not in names:
                path = _relative(listing, file.with_name(file.name.format(name)))
                yield Finding("missing", listing.name, path, f"file is missing{hint}", level)


def _check_lines(listing: Listing) -> Iterator[Finding]:
    """``poses.txt`` and ``times.txt`` have a line for each scan, also those without an image."""
    numbers = sorted(map(int, listing.found["image_2"]))
    if not numbers:
        return
    step, last = math.gcd(*numbers) or VOXEL_STRIDE, numbers[-1]
    for file in _LINES:
        count = listing.lines[file]
        if count and not last + 1 <= count <= last + step:
            message = f"{count} lines, the last image is {last:06d}"
            yield Finding("lines", listing.name, f"sequences/{listing.name}/{file}", message, NOTE)


def _check_names(root: Path, listing: Listing, part: str) -> Iterator[Finding]:
    """Files of other names in a folder of frames."""
    suffixes = {Path(file).suffix for file in FILES.values() if file.startswith(f"{part}/")}
    for name in _entries(listing.path / part):
        stem, suffix = os.path.splitext(name)
        if suffix in suffixes and stem.isascii() and stem.isdigit():
            continue
        kind = "leftovers" if _is_leftover(name) else "other-files"
        file = (listing.path / part / name).relative_to(root).as_posix()
        yield Finding(kind, listing.name, file, "is not read", NOTE)


def _check_elsewhere(root: Path, uses: Mapping[str, str]) -> Iterator[Finding]:
    """Parts that a sequence lacks and that lie in another folder with ``sequences``."""
    for other in nearby_roots(root):
        folder = other / "sequences"
        lacking: dict[str, list[str]] = {}
        for name in sequence_folders(folder):
            for part in ARCHIVES:
                here = root / "sequences" / name / part
                if (folder / name / part).exists() and not here.exists():
                    lacking.setdefault(part, []).append(name)
        for part, names in lacking.items():
            needed = any(uses.get(name) in LABELLED_SPLITS for name in names)
            message = f"has {part} of sequences {', '.join(names)}, which {root}/sequences lacks"
            level = ERROR if needed else NOTE
            place = os.path.relpath(folder, root)
            yield Finding("elsewhere", None, place, message, level)


def _relative(listing: Listing, path: Path) -> str:
    return f"sequences/{listing.name}/{path.relative_to(listing.path).as_posix()}"


def _is_leftover(name: str) -> bool:
    return name.startswith("._") or name in _LEFTOVERS


def _entries(folder: Path) -> list[str]:
    """The names in a folder, sorted; none if it cannot be read."""
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return []
