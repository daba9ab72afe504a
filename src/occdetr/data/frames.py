"""The frames of a dataset folder in SemanticKITTI's layout.

``sequences/NN/{image_2/*.png, calib.txt, voxels/*.{bin,label,invalid,occluded}}`` as in the
dataset's "semantic scene completion" download (http://semantic-kitti.org/dataset.html).
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from occdetr.data.find_root import sequence_folders, sequences_folder
from occdetr.errors import InputError

#: The splits, and those that have labels.
SPLITS = ("train", "val", "test")
LABELLED_SPLITS = ("train", "val")

TRAIN_SEQUENCES = ("00", "01", "02", "03", "04", "05", "06", "07", "09", "10")
VAL_SEQUENCES = ("08",)
TEST_SEQUENCES = tuple(str(number) for number in range(11, 22))

#: Where a frame's files are in its sequence's folder; {} is the frame's name.
IMAGE_FILE = "image_2/{}.png"
VOXEL_FILES = {kind: f"voxels/{{}}.{kind}" for kind in ("bin", "label", "invalid", "occluded")}

#: Voxels of SemanticKITTI are of every fifth scan.
VOXEL_STRIDE = 5


@dataclass(frozen=True)
class Frame:
    """The files of one frame.

    ``voxels`` is the path of the voxel files without their suffix, None if there are none.
    ``dataset`` names a dataset folder that is used beside another one, in which a sequence may have
    the same name.
    """

    sequence: str
    name: str
    image: Path
    calibration: Path
    voxels: Path | None = None
    dataset: str = ""

    @property
    def id(self) -> str:
        """Sequence and frame, as in ``00/000005``, behind the ``dataset``, if there is one."""
        return "/".join(filter(None, (self.dataset, self.sequence, self.name)))

    def voxel_file(self, kind: str) -> Path:
        """Path of the ``bin``, ``label``, ``invalid`` or ``occluded`` grid of this frame."""
        if self.voxels is None:
            raise InputError(f"frame {self.id} of {self.image} has no voxel files: add them")
        return self.voxels.parent / f"{self.voxels.name}.{kind}"


def find_frames(
    root: Path | str,
    sequences: Sequence[str | int],
    stride: int = 5,
    labels: bool = True,
    allow_partial: bool = False,
) -> list[Frame]:
    """Frames of ``sequences`` below ``root`` whose number is a multiple of ``stride``, in order.

    A frame needs its image; with ``labels`` its ``.label`` and ``.invalid`` too; without (the test
    split) its ``.bin``, if the sequence has a ``voxels`` folder at all. Scans after the last
    ``.bin`` are then no frames: those of the hidden test have no voxels.

    Raises ``InputError`` if the root, a sequence or its ``calib.txt`` is missing, if a sequence
    yields no frame, and if frames lack a file. With ``allow_partial`` these are left out with a
    warning.
    """
    if stride < 1:
        raise InputError(f"stride={stride}: give a stride of 1 or more")
    folder = sequences_folder(Path(root))
    sequences = (sequences,) if isinstance(sequences, str) else sequences
    if not sequences:
        raise InputError(f"no sequence to read in {folder}: name at least one")
    names = list(dict.fromkeys(sequence_name(sequence) for sequence in sequences))
    found = [_read_sequence(folder, name, stride, labels) for name in names]
    _report_incomplete(found, stride, allow_partial)
    return [frame for sequence in found for frame in sequence.frames]


def find_extra_frames(root: Path | str, stride: int, allow_partial: bool = False) -> list[Frame]:
    """The labelled frames of a dataset folder that is trained on beside another one: those of all
    its sequences except 08 and 11 to 21, which SemanticKITTI holds out.

    Raises ``InputError`` as ``find_frames`` does, and if there is no such sequence.
    """
    if not Path(root).exists():
        raise InputError(
            f"data.extra_roots: there is no folder {root}: write streets there (the recipe, or "
            "docs/own-data.md, says how), or train without: 'data.extra_roots=[]'"
        )
    folder = sequences_folder(Path(root), "data.extra_roots=[{}]")
    held_out = {*VAL_SEQUENCES, *TEST_SEQUENCES}
    names = [name for name in sequence_folders(folder) if name == sequence_name(name)]
    sequences = [name for name in names if name not in held_out]
    if not sequences:
        raise InputError(
            f"data.extra_roots={root}: {folder} has no sequence besides 08 and 11 to 21: add one, "
            "or leave this folder out"
        )
    place = os.path.realpath(root)
    dataset = f"{Path(place).name}-{hashlib.sha256(place.encode()).hexdigest()[:8]}"
    frames = find_frames(root, sequences, stride, allow_partial=allow_partial)
    return [dataclasses.replace(frame, dataset=dataset) for frame in frames]


def summarize_frames(frames: list[Frame], stride: int) -> str:
    """The frames found in one line: ``815 frames (sequence 08, stride 5)``."""
    names = list(dict.fromkeys(frame.sequence for frame in frames))
    count = f"{len(frames):,} frame{'' if len(frames) == 1 else 's'}"
    listed = f"sequence{'' if len(names) == 1 else 's'} {', '.join(names) or 'none'}"
    return f"{count} ({listed}, stride {stride})"


def choose_frames(frames: Sequence[Frame], wanted: Any, where: str) -> list[Frame]:
    """The frames that a setting selects: ``all``, a number (the first so many), or names as in
    ``00/000000,04/000005``.

    ``where`` describes the source of ``frames`` in error messages. Raises ``InputError``, which
    lists the frames there are, if a named one does not exist.
    """
    text = ",".join(map(str, wanted)) if isinstance(wanted, list) else str(wanted).strip()
    if text == "all":
        return list(frames)
    if text.isdecimal() and int(text) > 0:
        return list(frames[: int(text)])
    by_id = {frame.id: frame for frame in frames}
    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if name not in by_id:
            raise InputError(
                f"frames={name}: no such frame in {where}: "
                f"use all, a number, or names of {_frame_ranges(frames)}"
            )
    return [by_id[name] for name in names]


def _frame_ranges(frames: Sequence[Frame]) -> str:
    """Each sequence's first and last frame: ``00/000000 to 000005 (2), ...``."""
    names: dict[str, list[str]] = {}
    for frame in frames:
        names.setdefault(frame.sequence, []).append(frame.name)
    return ", ".join(
        f"{sequence}/{found[0]} to {found[-1]} ({len(found)})" for sequence, found in names.items()
    )


@dataclass(frozen=True)
class _Sequence:
    """The complete frames of a sequence, how many there should be, the first missing file."""

    path: Path
    frames: list[Frame]
    expected: int
    missing: Path | None


def _report_incomplete(sequences: list[_Sequence], stride: int, allow_partial: bool) -> None:
    """Raise ``InputError`` if frames lack files, or warn if that is allowed."""
    partial = [sequence for sequence in sequences if sequence.missing is not None]
    if not partial:
        return
    counts = ", ".join(f"{s.path.name}: {len(s.frames)} of {s.expected}" for s in partial)
    message = (
        f"{partial[0].missing}: file is missing; complete frames by sequence (stride {stride}): "
        f"{counts}"
    )
    if not allow_partial:
        raise InputError(
            f"{message}: add the missing files, or set data.allow_partial=true to do without"
        )
    warnings.warn(f"{message}: the others are left out", stacklevel=3)


def sequence_name(sequence: str | int) -> str:
    """The folder of a sequence, as in ``08``. Raises ``InputError`` if it is no number."""
    text = str(sequence).strip()
    if isinstance(sequence, bool) or not (text.isascii() and text.isdecimal()):
        raise InputError(f"sequence {sequence!r}: give a number such as 08")
    return f"{int(text):02d}"


def _read_sequence(folder: Path, sequence: str, stride: int, labels: bool) -> _Sequence:
    path = folder / sequence
    if not path.is_dir():
        present = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
        raise InputError(
            f"{path}: sequence {sequence} is missing (found: {', '.join(present) or 'none'}): "
            "unpack it there, or name other sequences"
        )
    calibration = path / "calib.txt"
    if not calibration.is_file():
        raise InputError(f"{calibration}: file is missing: copy it from KITTI odometry's calib")
    has_voxels = (path / "voxels").is_dir()
    files = needed_files(path, labels)
    found = {file: frame_names(file) for file in files}
    complete = set.intersection(*found.values())
    if not complete:
        counts = ", ".join(
            f"{len(names)} {file.parent.name}/*{file.suffix}" for file, names in found.items()
        )
        raise InputError(
            f"{path}: no frame is complete (found {counts}): "
            "unpack KITTI odometry's color images and SemanticKITTI's voxels there"
        )
    expected = expected_names(path, list(found.values()), stride)
    if has_voxels and not labels:
        last = max(map(int, found[files[-1]]))
        expected = [name for name in expected if int(name) <= last]
    missing = [
        file.with_name(file.name.format(name))
        for name in expected
        for file in files
        if name not in found[file]
    ]
    frames = [
        Frame(
            sequence=sequence,
            name=name,
            image=path / IMAGE_FILE.format(name),
            calibration=calibration,
            voxels=path / "voxels" / name if has_voxels else None,
        )
        for name in expected
        if name in complete
    ]
    if not expected:
        others = {s: sum(int(n) % s == 0 for n in complete) for s in (1, 2, 5, 10) if s != stride}
        counts = ", ".join(f"stride {s} finds {count}" for s, count in others.items() if count)
        raise InputError(f"{path}: no frame with stride {stride}: {counts} (set data.stride)")
    return _Sequence(path, frames, len(expected), missing[0] if missing else None)


def needed_files(path: Path, labels: bool) -> list[Path]:
    """The files that a frame of the sequence at ``path`` needs, its image first; {} is its name."""
    kinds = ("label", "invalid") if labels else ("bin",)
    has_voxels = labels or (path / "voxels").is_dir()
    return [path / IMAGE_FILE, *(path / VOXEL_FILES[kind] for kind in kinds if has_voxels)]


def expected_names(path: Path, found: list[set[str]], stride: int) -> list[str]:
    """Names of the frames that a whole sequence would have, in order; ``found`` are the names that
    have each of the needed files, the image first.

    These are all that have a file of any kind, and, if there is KITTI's ``times.txt`` with a line
    for each scan, all up to its end. Images are of every scan and voxels of every fifth, so an
    image alone makes a frame only where voxels are due: at multiples of the numbers that have some.
    """
    images, voxels = found[0], set().union(*found[1:])
    step = math.gcd(*map(int, voxels or images)) or VOXEL_STRIDE
    due = math.lcm(stride, step)
    names = {name for name in voxels if int(name) % stride == 0}
    names |= {name for name in images if int(name) % due == 0}
    numbers = {int(name) for name in names}
    names |= {f"{n:06d}" for n in range(0, line_count(path / "times.txt"), due) if n not in numbers}
    return sorted(names, key=int)


def line_count(file: Path) -> int:
    """Number of lines with text in ``times.txt`` or ``poses.txt``, which have one for each scan; 0
    if there is no such file."""
    try:
        return sum(bool(line.strip()) for line in file.read_bytes().splitlines())
    except OSError:
        return 0


def frame_names(file: Path) -> set[str]:
    """Names of the frames that have a ``file``, in which {} is the name."""
    if not file.parent.is_dir():
        return set()
    with os.scandir(file.parent) as entries:
        files = [entry.name for entry in entries if entry.name.endswith(file.suffix)]
    stems = {name[: -len(file.suffix)] for name in files}
    return {stem for stem in stems if stem.isascii() and stem.isdigit()}
