"""The frames of a dataset folder in SemanticKITTI's layout.

``sequences/NN/{image_2/*.png, calib.txt, voxels/*.{bin,label,invalid,occluded}}`` as in the
dataset's "semantic scene completion" download (http://semantic-kitti.org/dataset.html).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from occdetr.errors import InputError

#: The splits, and those that have labels.
SPLITS = ("train", "val", "test")
LABELLED_SPLITS = ("train", "val")

TRAIN_SEQUENCES = ("00", "01", "02", "03", "04", "05", "06", "07", "09", "10")
VAL_SEQUENCES = ("08",)
TEST_SEQUENCES = tuple(str(number) for number in range(11, 22))


@dataclass(frozen=True)
class Frame:
    """The files of one frame.

    ``voxels`` is the path of the voxel files without their suffix, None if there are none.
    """

    sequence: str
    name: str
    image: Path
    calibration: Path
    voxels: Path | None = None

    @property
    def id(self) -> str:
        """Sequence and frame, as in ``00/000005``."""
        return f"{self.sequence}/{self.name}"

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
) -> list[Frame]:
    """Frames of ``sequences`` below ``root`` whose number is a multiple of ``stride``, in order.

    A frame needs its image; with ``labels`` its ``.label`` and ``.invalid`` too; without (the test
    split) its ``.bin``, if the sequence has a ``voxels`` folder at all.

    Raises ``InputError`` if the root, a sequence or its ``calib.txt`` is missing, or if a sequence
    yields no frame.
    """
    if stride < 1:
        raise InputError(f"stride={stride}: give a stride of 1 or more")
    folder = Path(root) / "sequences"
    if not folder.is_dir():
        raise InputError(
            f"{Path(root)}: no dataset there (it has no folder 'sequences'): "
            "set data.root to the folder that holds 'sequences'"
        )
    sequences = (sequences,) if isinstance(sequences, str) else sequences
    if not sequences:
        raise InputError(f"no sequence to read in {folder}: name at least one")
    return [
        frame
        for sequence in sequences
        for frame in _sequence_frames(folder, _sequence_name(sequence), stride, labels)
    ]


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


def _sequence_name(sequence: str | int) -> str:
    try:
        return f"{int(sequence):02d}"
    except ValueError:
        raise InputError(f"sequence {sequence!r}: give a number such as 08") from None


def _sequence_frames(folder: Path, sequence: str, stride: int, labels: bool) -> list[Frame]:
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
    names = _complete_names(path, labels)
    chosen = [name for name in names if int(name) % stride == 0]
    if not chosen:
        others = {s: sum(int(n) % s == 0 for n in names) for s in (1, 2, 5, 10) if s != stride}
        found = ", ".join(f"stride {s} finds {count}" for s, count in others.items() if count)
        raise InputError(f"{path}: no frame with stride {stride}: {found} (set data.stride)")
    has_voxels = (path / "voxels").is_dir()
    return [
        Frame(
            sequence=sequence,
            name=name,
            image=path / "image_2" / f"{name}.png",
            calibration=calibration,
            voxels=path / "voxels" / name if has_voxels else None,
        )
        for name in chosen
    ]


def _complete_names(path: Path, labels: bool) -> list[str]:
    """Names of the frames of a sequence that have every file required."""
    kinds = [("image_2", ".png")]
    if labels:
        kinds += [("voxels", ".label"), ("voxels", ".invalid")]
    elif (path / "voxels").is_dir():
        kinds += [("voxels", ".bin")]
    stems = [_stems(path / folder, suffix) for folder, suffix in kinds]
    names = set.intersection(*stems)
    if not names:
        counts = ", ".join(
            f"{len(found)} {folder}/*{suffix}"
            for found, (folder, suffix) in zip(stems, kinds, strict=True)
        )
        raise InputError(
            f"{path}: no frame is complete (found {counts}): "
            "unpack KITTI odometry's color images and SemanticKITTI's voxels there"
        )
    return sorted(names, key=int)


def _stems(folder: Path, suffix: str) -> set[str]:
    """Names (without suffix) of the frames that have a file in ``folder``."""
    if not folder.is_dir():
        return set()
    with os.scandir(folder) as entries:
        stems = {entry.name[: -len(suffix)] for entry in entries if entry.name.endswith(suffix)}
    return {stem for stem in stems if stem.isascii() and stem.isdigit()}
