"""The root of a data set: the folder that holds ``sequences/NN``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from occdetr.errors import InputError

_DEPTH = 2  # levels below the given folder that are searched
_MOST_FOLDERS = 200  # of each level


def sequences_folder(root: Path, setting: str = "data.root={}") -> Path:
    """The folder ``sequences`` of a data set's ``root``, which ``setting`` gives ({}).

    Raises ``InputError`` if there is none, or if it holds no sequence and another root is near; the
    message names that root.
    """
    folder = root / "sequences"
    if has_sequences(folder):
        return folder
    near = nearby_roots(root)
    if folder.is_dir() and not near:
        return folder
    if near:
        remedy = f"set {setting.format(near[0])}"
    elif has_sequences(root):
        remedy = f"move its folders {', '.join(sequence_folders(root)[:3])} ... into {folder}"
    else:
        remedy = f"set {setting.partition('=')[0]} to the folder that holds 'sequences'"
    state = "it has no folder 'sequences'" if root.is_dir() else "there is no such folder"
    if folder.is_dir():
        state = f"{folder} holds no sequence"
    raise InputError(f"{root}: no dataset there ({state}): {remedy}")


def nearby_roots(root: Path) -> list[Path]:
    """Roots of data sets that a user may have meant by ``root``: above it, if it is a folder
    ``sequences`` or one in it, and below it."""
    above = Path(os.path.abspath(root))
    parents = [path.parent for path in (above, above.parent) if path.name == "sequences"]
    if not root.is_absolute():
        parents = [Path(os.path.relpath(path)) for path in parents]
    return [path for path in (*parents, *_below(root)) if has_sequences(path / "sequences")]


def has_sequences(folder: Path) -> bool:
    """Whether a folder holds sequences, as in ``00``, with any of the files of a data set."""
    return any(
        (folder / name / part).exists()
        for name in sequence_folders(folder)
        for part in ("image_2", "voxels", "calib.txt", "image_0", "image_3", "velodyne")
    )


def sequence_folders(folder: Path) -> list[str]:
    """Names of the sequences in a folder, sorted."""
    return [name for name in _folders(folder) if re.fullmatch(r"[0-9]{2,}", name)]


def _below(root: Path, depth: int = _DEPTH) -> Iterator[Path]:
    """The folders below ``root``, the near ones first."""
    level = [root]
    for _ in range(depth):
        level = [path / name for path in level for name in _folders(path)][:_MOST_FOLDERS]
        level = [path for path in level if path.name != "__MACOSX" and path.name[0] != "."]
        yield from level


def _folders(path: Path) -> list[str]:
    """The folders in a folder, sorted; none if it cannot be read."""
    try:
        with os.scandir(path) as entries:
            return sorted(entry.name for entry in entries if entry.is_dir())
    except OSError:
        return []
