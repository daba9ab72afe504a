"""What the check of a data set finds, the kinds of it, and what to do about each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

#: Levels: what stops training and evaluation or makes them wrong, and what is odd but harmless.
ERROR, NOTE = "error", "note"


@dataclass(frozen=True)
class Kind:
    """A kind of finding: what it is, as a heading, and how it is fixed if it is an error.

    In ``fix``, {file} is the first file, {more} how many follow, {sequences} where they are, {root}
    the data set's root, {choose} the settings that do with the sequences that are there, {stride}
    the ``data.stride`` that takes all frames, and {get_image_2}, {get_voxels} and {get_calib} how
    the archive with these files is unpacked.
    """

    title: str
    fix: str = ""


_AGAIN = "copy or download {file}{more} again"
_PARTIAL = "or set data.allow_partial=true to do without these frames"

#: In the order in which they are to be fixed.
KINDS: Mapping[str, Kind] = {
    "sequence": Kind(
        "sequences are missing", "unpack sequences {sequences} from the archives{choose}"
    ),
    "elsewhere": Kind(
        "parts of sequences are in another folder", "move what is in {file} to {root}/sequences"
    ),
    "no-images": Kind("sequences without color images (image_2)", "{get_image_2}"),
    "no-voxels": Kind("sequences without voxels", "{get_voxels}"),
    "no-calib": Kind("calib.txt is missing", "{get_calib}"),
    "calib": Kind(
        "calib.txt cannot be used", "{get_calib} (the calib.txt of the image archives has no Tr)"
    ),
    "other-calib": Kind(
        "calib.txt belongs to other images",
        "give {file} the calibration of its own sequence: {get_calib}",
    ),
    "names": Kind(
        "images and voxels have names that do not fit",
        "give the images in {file} the names that KITTI odometry's have: take "
        "data_odometry_color.zip, not the raw recordings",
    ),
    "numbers": Kind(
        "voxels have other numbers than their images",
        "give the voxels the numbers of their scans (every fifth: 000000, 000005, ...), "
        "or unpack data_odometry_voxels.zip again",
    ),
    "stride": Kind("no frame fits data.stride", "set data.stride={stride}"),
    "missing": Kind(
        "frames lack a file", f"copy the missing files, which check.json lists, {_PARTIAL}"
    ),
    "end": Kind(
        "the last frames have no voxels",
        "if the download has none (some frames are normal), set data.allow_partial=true; "
        "else unpack the voxels again",
    ),
    "image": Kind("images are broken", _AGAIN),
    "image-size": Kind("images do not belong to their calibration", _AGAIN),
    "voxels": Kind("voxel files are broken", _AGAIN),
    "labels": Kind("label files cannot be used", _AGAIN),
    "late": Kind(
        "voxels are one voxel late, as in release 1.0",
        "download data_odometry_voxels.zip of version 1.1 or later",
    ),
    "apart": Kind(
        "scan (.bin) and labels are one voxel apart",
        "take all voxel files from one data_odometry_voxels.zip of version 1.1 or later",
    ),
    "other-stride": Kind("data.stride leaves out frames that have voxels"),
    "camera": Kind("calib.txt does not say the size of its images (size: WIDTH HEIGHT)"),
    "gray": Kind("images are gray"),
    "lines": Kind("another number of lines than scans"),
    "velodyne": Kind("velodyne scans or their labels are broken"),
    "leftovers": Kind("files that macOS has left and that can be deleted"),
    "archives": Kind("archives are not read"),
    "other-files": Kind("files that are not read"),
}


@dataclass(frozen=True)
class Finding:
    """Something in a data set that is missing, odd or corrupt: a kind of ``KINDS``, the sequence
    (None: the data set as a whole), the file or folder relative to the root, and what is wrong."""

    kind: str
    sequence: str | None
    file: str
    message: str
    level: str = ERROR


@dataclass(frozen=True)
class Group:
    """The findings of one kind and level."""

    kind: str
    level: str
    findings: Sequence[Finding]

    @property
    def sequences(self) -> list[str]:
        return sorted({each.sequence for each in self.findings if each.sequence is not None})


def group_findings(findings: Sequence[Finding]) -> list[Group]:
    """Findings by level and kind: errors first, in the order in which they are to be fixed."""
    groups = []
    for level in (ERROR, NOTE):
        for kind in KINDS:
            own = [each for each in findings if (each.kind, each.level) == (kind, level)]
            if own:
                groups.append(Group(kind, level, own))
    return groups


def first_fix(findings: Sequence[Finding], places: Mapping[str, str]) -> str | None:
    """What to do first; None if there is no error. ``places`` fills in what ``Kind.fix`` names
    besides the files and their sequences."""
    for group in group_findings(findings):
        if group.level == ERROR:
            count, sequences = len(group.findings), ", ".join(group.sequences)
            own = {
                "file": group.findings[0].file,
                "more": f" and {count - 1} more, which check.json lists," if count > 1 else "",
                "sequences": sequences,
            }
            return KINDS[group.kind].fix.format(**own, **places)
    return None
