"""The zip file for SemanticKITTI's hidden test of semantic scene completion, and its check.

The rules are those of ``validate_submission.py`` of semantic-kitti-api: an entry for each folder,
exactly one ``.label`` for each ``.bin`` of the sequences 11 to 21, each with one uint16 a voxel.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from occdetr.data.frames import TEST_SEQUENCES, VOXEL_FILES, frame_names
from occdetr.errors import InputError
from occdetr.files import replacing
from occdetr.geometry.voxels import GRID_SHAPE

LABEL_BYTES = 2 * GRID_SHAPE[0] * GRID_SHAPE[1] * GRID_SHAPE[2]
DESCRIPTION = "description.txt"
#: Every file has this time, so that the same predictions give the same zip.
_TIME = (1980, 1, 1, 0, 0, 0)


def label_name(frame_id: str) -> str:
    """The entry of a frame, as in ``11/000005``."""
    sequence, name = frame_id.split("/")
    return f"sequences/{sequence}/predictions/{name}.label"


def write_submission(
    file: Path,
    predictions: Path,
    frame_ids: Iterable[str],
    description: Mapping[str, str],
    root: Path,
) -> int:
    """Write the predictions of these frames (``<predictions>/sequences/NN/predictions``) and a
    description; returns the number of predictions.

    An existing file is replaced when the new one is whole and fits the data set at ``root``.
    Raises ``InputError`` as ``check_submission``.
    """
    names = [label_name(frame_id) for frame_id in frame_ids]
    folders = {f"{parent}/" for name in names for parent in Path(name).parents if parent.name}
    text = "".join(f"{key}: {value}\n" for key, value in description.items())
    with replacing(file) as part:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
            for folder in sorted(folders):
                archive.writestr(zipfile.ZipInfo(folder, _TIME), b"")
            archive.writestr(_info(DESCRIPTION), text)
            for name in names:
                archive.writestr(_info(name), (predictions / name).read_bytes())
        return check_entries(part, file, root)


def _info(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _TIME)
    info.compress_type = zipfile.ZIP_DEFLATED
    return info


def check_submission(file: Path, root: Path) -> int:
    """Check a zip file against the data set; returns the number of predictions.

    Raises ``InputError``, which names the first entry that is missing, too many or of a wrong size.
    """
    if file.suffix != ".zip":
        raise InputError(f"{file}: the name must end with .zip")
    return check_entries(file, file, root)


def wanted_frames(root: Path) -> list[str]:
    """The frames of the hidden test, as in ``11/000005``: those with a ``.bin``."""
    return [
        f"{sequence}/{name}"
        for sequence in TEST_SEQUENCES
        for name in sorted(frame_names(root / "sequences" / sequence / VOXEL_FILES["bin"]))
    ]


def check_entries(content: Path, file: Path, root: Path) -> int:
    """``check_submission`` of what is to be ``file``."""
    try:
        with zipfile.ZipFile(content) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
            broken = archive.testzip()
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"{file}: is no whole zip file: {error}") from error
    if broken is not None:
        raise InputError(f"{file}: {broken} is damaged in it: write it again")
    folders = ["sequences/"]
    for sequence in TEST_SEQUENCES:
        folders += [f"sequences/{sequence}/", f"sequences/{sequence}/predictions/"]
    wanted = [label_name(frame_id) for frame_id in wanted_frames(root)]
    for name in [*folders, *wanted]:
        if name not in sizes:
            raise InputError(f"{file}: {name} is missing in it")
    for name in wanted:
        if sizes[name] != LABEL_BYTES:
            raise InputError(f"{file}: {name} has {sizes[name]} bytes in place of {LABEL_BYTES}")
    others = {name for name in sizes if not name.endswith("/")} - {*wanted, DESCRIPTION}
    if others:
        raise InputError(f"{file}: {min(others)} does not belong into it")
    return len(wanted)
