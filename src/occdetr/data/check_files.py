"""The files of a sequence, checked: images, voxels and scans, cheaply or as a whole."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from occdetr.classes import IGNORE, NUM_CLASSES
from occdetr.data.check_voxels import is_one_late, labels_ahead
from occdetr.data.findings import ERROR, NOTE, Finding
from occdetr.data.frames import Frame
from occdetr.data.listing import FILES
from occdetr.data.semantickitti import (
    VOXEL_BYTES,
    check_bytes,
    read_labels,
    read_mask,
    read_raw_labels,
)
from occdetr.errors import InputError
from occdetr.files import image_size_of, read_image

_POINT_BYTES, _POINT_LABEL_BYTES = 16, 4

_PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_HEADER_BYTES = 33
_END = b"\0\0\0\0IEND\xaeB`\x82"
_GRAY = (0, 4)  # colour types of a PNG


@dataclass(frozen=True)
class Job:
    """Frames of a sequence to check. ``found`` are the names that have each kind of ``FILES``;
    ``whole`` are the frames whose image and voxels are read, ``labelled`` if they have labels."""

    root: Path
    sequence: str
    found: Mapping[str, Sequence[str]]
    whole: Sequence[Frame] = ()
    labelled: bool = True

    def file(self, kind: str, name: str) -> str:
        """A file relative to the root."""
        return f"sequences/{self.sequence}/{FILES[kind].format(name)}"


@dataclass
class Checked:
    """The result of a ``Job``: what is wrong, the images by their (height, width), and how many
    frames were read; of those without labels, how many have a scan that is not empty, and how many
    voxels lie in the lowest layer of these scans."""

    findings: list[Finding] = field(default_factory=list)
    images: dict[tuple[int, int], list[str]] = field(default_factory=dict)
    whole: int = 0
    scans: int = 0
    lowest: int = 0


def check_files(job: Job) -> Checked:
    """Check the headers and ends of images and the sizes of voxel files and scans; then read the
    frames of ``job.whole`` that are without a finding."""
    done = Checked()
    for name in job.found.get("image_2", ()):
        _check_image(job, job.file("image_2", name), done)
    for kind in VOXEL_BYTES:
        for name in job.found.get(kind, ()):
            path = job.root / job.file(kind, name)
            try:
                check_bytes(path, VOXEL_BYTES[kind], path.stat().st_size)
            except (InputError, OSError) as error:
                _add(job, done, "voxels", path, error)
    done.findings += _check_scans(job)
    broken = {finding.file for finding in done.findings if finding.level == ERROR}
    for frame in job.whole:
        if not broken & {job.file(kind, frame.name) for kind in FILES}:
            _read_frame(job, frame, done)
            done.whole += 1
    return done


def png_header(path: Path) -> tuple[int, int, bool] | None:
    """Height, width and whether it is gray of a PNG with a sound header and an end; None of any
    other file."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
            file.seek(-len(_END), os.SEEK_END)
            end = file.read()
    except OSError:
        return None
    checksum = int.from_bytes(head[29:33])
    if not head.startswith(_PNG) or end != _END or zlib.crc32(head[12:29]) != checksum:
        return None
    return int.from_bytes(head[20:24]), int.from_bytes(head[16:20]), head[25] in _GRAY


def _check_image(job: Job, file: str, done: Checked) -> None:
    path = job.root / file
    header = png_header(path)
    try:
        size = header[:2] if header else image_size_of(path)
    except InputError as error:
        _add(job, done, "image", path, error)
        return
    done.images.setdefault(size, []).append(file)
    if header and header[2]:
        done.findings.append(Finding("gray", job.sequence, file, "PNG without colors", NOTE))


def _check_scans(job: Job) -> Iterator[Finding]:
    """The sizes of LiDAR scans (four float32 a point) and of their labels (a uint32 a point)."""
    points: dict[str, int] = {}
    for name in job.found.get("velodyne", ()):
        file = job.file("velodyne", name)
        size = (job.root / file).stat().st_size
        points[name] = size // _POINT_BYTES
        if size == 0 or size % _POINT_BYTES:
            message = f"{size:,} bytes are no whole points"
            yield Finding("velodyne", job.sequence, file, message, NOTE)
    for name in job.found.get("labels", ()):
        file = job.file("labels", name)
        labels = (job.root / file).stat().st_size / _POINT_LABEL_BYTES
        if labels != points.get(name, labels):
            message = f"{labels:,.0f} labels for {points[name]:,} points"
            yield Finding("velodyne", job.sequence, file, message, NOTE)


def _read_frame(job: Job, frame: Frame, done: Checked) -> None:
    """Decode the image of a frame, read its voxels, and compare them with each other."""
    try:
        read_image(frame.image)
    except InputError as error:
        _add(job, done, "image", frame.image, error)
    if frame.voxels is None:
        return
    label, scan = frame.voxel_file("label"), frame.voxel_file("bin")
    if not job.labelled:
        layers = np.count_nonzero(read_mask(scan), axis=(0, 1))
        done.scans += int(layers.any())
        done.lowest += int(layers[0])
        return
    try:
        read_labels(frame)
    except InputError as error:
        _add(job, done, "labels", label, InputError(_with_hint(error, label)))
        return
    if is_one_late(read_mask(frame.voxel_file("invalid"))):
        message = "the highest voxels of each column are the lowest of the next one"
        done.findings.append(Finding("late", job.sequence, _relative(job, label), message))
    elif frame.name in job.found.get("bin", ()):
        shift = labels_ahead(read_mask(scan), read_raw_labels(label) != 0)
        if shift:
            message = f"most voxels of {scan.name} have their label {shift:+d} voxel further"
            done.findings.append(Finding("apart", job.sequence, _relative(job, label), message))


def _with_hint(error: InputError, label: Path) -> str:
    """The error's line; if the file has classes (0 to 19) in place of raw ids, it says so."""
    if "unknown raw label id" in str(error):
        raw = read_raw_labels(label)
        if raw[raw != IGNORE].max(initial=0) < NUM_CLASSES:
            return f"{label}: holds classes from 0 to 19, not the raw ids of SemanticKITTI"
    return str(error)


def _relative(job: Job, path: Path) -> str:
    return path.relative_to(job.root).as_posix()


def _add(job: Job, done: Checked, kind: str, path: Path, error: Exception) -> None:
    """Add an error of reading ``path`` as a finding, without the name of the file."""
    text = error.strerror or "" if isinstance(error, OSError) else str(error)
    message = " ".join(text.removeprefix(f"{path}: ").splitlines())
    done.findings.append(Finding(kind, job.sequence, _relative(job, path), message))
