"""What lies in the folder of a sequence."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from occdetr.data.frames import (
    IMAGE_FILE,
    LABELLED_SPLITS,
    VOXEL_FILES,
    expected_names,
    frame_names,
    line_count,
    needed_files,
)
from occdetr.errors import InputError
from occdetr.geometry.kitti import Calibration, read_calibration

#: Files that may lie in a sequence's folder, by the name of their kind; {} is the frame's name.
FILES: Mapping[str, str] = {
    "image_2": IMAGE_FILE,
    **VOXEL_FILES,
    "velodyne": "velodyne/{}.bin",
    "labels": "labels/{}.label",
}


@dataclass(frozen=True)
class Listing:
    """A sequence's folder: the frame names of each kind of ``FILES``, the lines of ``poses.txt``
    and ``times.txt``, and the calibration if it can be used.

    ``split`` is how the settings use the sequence, None: not at all. ``expected`` are the frames
    that the whole sequence has with ``stride``.
    """

    name: str
    path: Path
    split: str | None
    stride: int
    found: Mapping[str, set[str]]
    lines: Mapping[str, int]
    calibration: Calibration | None
    expected: Sequence[str]

    @property
    def labelled(self) -> bool:
        """Whether its frames need labels; of a sequence without a use, whether it has some."""
        return self.split in LABELLED_SPLITS if self.split else bool(self.found["label"])

    @cached_property
    def needed(self) -> Mapping[Path, set[str]]:
        """The files that a frame needs, with {} for its name, and the names that have each."""
        return {
            file: self.found[kind]
            for file in needed_files(self.path, self.labelled)
            for kind, pattern in FILES.items()
            if self.path / pattern == file
        }

    @cached_property
    def whole(self) -> set[str]:
        """The frames that have every file, whatever the stride."""
        return set.intersection(*self.needed.values())

    @cached_property
    def complete(self) -> list[str]:
        """The expected frames that have every file."""
        return [name for name in self.expected if name in self.whole]

    @property
    def voxel_names(self) -> set[str]:
        """Frames that have any of the voxel files that are needed."""
        return set().union(*list(self.needed.values())[1:])


def list_sequence(path: Path, split: str | None, stride: int) -> Listing:
    """What lies in the folder of a sequence."""
    try:
        calibration = read_calibration(path / "calib.txt")
    except InputError:
        calibration = None
    found = {kind: frame_names(path / file) for kind, file in FILES.items()}
    poses = line_count(path / "poses.txt") or line_count(
        path.parents[1] / "poses" / f"{path.name}.txt"
    )
    lines = {"times.txt": line_count(path / "times.txt"), "poses.txt": poses}
    bare = Listing(path.name, path, split, stride, found, lines, calibration, ())
    expected = expected_names(path, list(bare.needed.values()), stride)
    return dataclasses.replace(bare, expected=expected)
