"""The check of a whole data set: what is there, what is missing, odd or corrupt."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from occdetr.data.check_files import Checked, Job, check_files
from occdetr.data.check_layout import check_folders, check_sequence
from occdetr.data.datamodule import DatasetFolder
from occdetr.data.find_root import sequence_folders, sequences_folder
from occdetr.data.findings import ERROR, NOTE, Finding
from occdetr.data.frames import LABELLED_SPLITS, SPLITS, Frame, sequence_name
from occdetr.data.images import fitting_camera
from occdetr.data.listing import FILES, Listing, list_sequence
from occdetr.data.parallel import in_processes
from occdetr.errors import InputError

_CHUNK = 256  # frames of a job
_FEW = 2000  # files that are checked sooner than processes start
_ENOUGH = 5  # scans, of which some reach below the ground in front of the car


@dataclass(frozen=True)
class DatasetCheck:
    """The result of ``check_dataset``: the sequences that are there, all findings, the images of
    each sequence by (height, width), and the number of frames that were read as a whole."""

    root: Path
    listings: Sequence[Listing]
    findings: Sequence[Finding]
    images: Mapping[str, Mapping[tuple[int, int], int]]
    whole: int

    @property
    def usable(self) -> bool:
        """Whether training and evaluation can run with this data."""
        return all(finding.level != ERROR for finding in self.findings)


def check_dataset(
    folder: DatasetFolder, whole: int = 10, workers: int = 1, progress: bool = True
) -> DatasetCheck:
    """Check the files of a data set, with the settings that ``folder`` gives.

    Headers and ends of images and sizes of voxel files are checked for all; ``whole`` frames of
    each sequence (0: all) are read. What the training and the validation sequences need is an
    error where it is missing or corrupt; all else is a note. Nothing is written. ``progress`` shows
    a bar. Raises ``InputError`` if there is no data set in the root or a setting is wrong.
    """
    root = Path(folder.root)
    sequences, uses = sequences_folder(root), _uses(folder)
    present = sequence_folders(sequences)
    listings = [list_sequence(sequences / name, uses.get(name), folder.stride) for name in present]
    findings = list(_missing_sequences(uses, present))
    for listing in listings:
        findings += _levelled(listing, check_sequence(listing, folder.allow_partial))
    findings += check_folders(root, listings, uses)
    jobs = [job for listing in listings for job in _jobs(root, listing, whole)]
    done = dict.fromkeys(present, Checked())
    for job, result in zip(jobs, _run(jobs, workers, progress), strict=True):
        done[job.sequence] = _joined(done[job.sequence], result)
    for listing in listings:
        result = done[listing.name]
        found = [*result.findings, *_check_sizes(root, listing, result.images)]
        found += _check_lowest(listing, result)
        findings += _levelled(listing, found)
    images = {
        name: {size: len(files) for size, files in result.images.items()}
        for name, result in done.items()
    }
    read = sum(result.whole for result in done.values())
    return DatasetCheck(root, listings, findings, images, read)


def _uses(folder: DatasetFolder) -> dict[str, str]:
    """The split of each sequence that the settings name; of several, the first."""
    uses: dict[str, str] = {}
    for split in SPLITS:
        names = [sequence_name(each) for each in getattr(folder, f"{split}_sequences")]
        if not names and split in LABELLED_SPLITS:
            raise InputError(f"data.{split}_sequences=[]: name at least one sequence")
        for name in names:
            uses.setdefault(name, split)
    return uses


def _missing_sequences(uses: Mapping[str, str], present: Sequence[str]) -> Iterator[Finding]:
    for name, split in uses.items():
        if name not in present:
            level = ERROR if split in LABELLED_SPLITS else NOTE
            message = f"is missing (data.{split}_sequences)"
            yield Finding("sequence", name, f"sequences/{name}", message, level)


def _levelled(listing: Listing, findings: Sequence[Finding] | Iterator[Finding]) -> list[Finding]:
    """Findings, as notes where training and evaluation do not need the file."""
    patterns = [file.relative_to(listing.path).as_posix() for file in listing.needed]
    used = {
        f"sequences/{listing.name}/{pattern.format(name)}"
        for pattern in patterns
        for name in listing.expected
    }

    def is_needed(finding: Finding) -> bool:
        of_frame = finding.kind in ("image", "image-size", "voxels", "labels", "late", "apart")
        return listing.split in LABELLED_SPLITS and (not of_frame or finding.file in used)

    return [each if is_needed(each) else dataclasses.replace(each, level=NOTE) for each in findings]


def _jobs(root: Path, listing: Listing, whole: int) -> Iterator[Job]:
    """The work of a sequence in parts of some frames each, among them those to be read."""
    names = sorted(set().union(*listing.found.values()))
    chosen = set(_spread(listing.complete, whole))
    for start in range(0, len(names), _CHUNK):
        part = set(names[start : start + _CHUNK])
        found = {kind: sorted(part & listing.found[kind]) for kind in FILES}
        frames = [_frame(listing, name) for name in sorted(part & chosen)]
        yield Job(root, listing.name, found, frames, listing.labelled)


def _spread(names: Sequence[str], count: int) -> list[str]:
    """``count`` of the names, evenly spread from the first to the last; 0: all."""
    if count == 0 or count >= len(names):
        return list(names)
    return [names[round(i * (len(names) - 1) / max(count - 1, 1))] for i in range(count)]


def _frame(listing: Listing, name: str) -> Frame:
    files = [file.with_name(file.name.format(name)) for file in listing.needed]
    voxels = files[1].with_suffix("") if len(files) > 1 else None
    return Frame(listing.name, name, files[0], listing.path / "calib.txt", voxels)


def _run(jobs: Sequence[Job], workers: int, progress: bool) -> Iterator[Checked]:
    """Check in this process or, if there is much, in spawned ones; yields after each job."""
    columns = (
        TextColumn("[progress.description]{task.description}"),
        *(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()),
    )
    counts = [sum(map(len, job.found.values())) for job in jobs]
    alone = workers <= 1 or sum(counts) < _FEW
    results = map(check_files, jobs) if alone else in_processes(check_files, jobs, workers)
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task("checking files", total=sum(counts))
        for count, result in zip(counts, results, strict=True):
            yield result
            bar.advance(task, count)


def _joined(one: Checked, two: Checked) -> Checked:
    sizes = [*one.images, *(size for size in two.images if size not in one.images)]
    images = {size: one.images.get(size, []) + two.images.get(size, []) for size in sizes}
    sums = {name: getattr(one, name) + getattr(two, name) for name in ("whole", "scans", "lowest")}
    return Checked(one.findings + two.findings, images, **sums)


def _check_sizes(
    root: Path, listing: Listing, images: Mapping[tuple[int, int], Sequence[str]]
) -> Iterator[Finding]:
    """Images whose size does not fit the calibration or, if it says none, most of the others."""
    if listing.calibration is None or not images:
        return
    usual = max(images, key=lambda size: len(images[size]))
    calibration, misfits = listing.path / "calib.txt", {}
    for size, files in images.items():
        try:
            with warnings.catch_warnings(action="ignore"):
                fitting_camera(root / files[0], size, calibration)
        except InputError as error:
            text = str(error).removeprefix(f"{root / files[0]}: ")
            misfits[size] = text.replace(str(calibration), "calib.txt")
        else:
            if listing.calibration.image_size is None and size != usual:
                misfits[size] = "{1} x {0} pixels, most have {3} x {2}".format(*size, *usual)
    if len(misfits) == len(images):
        file = f"sequences/{listing.name}/calib.txt"
        yield Finding("other-calib", listing.name, file, misfits[usual])
        return
    for size, message in misfits.items():
        yield from (Finding("image-size", listing.name, file, message) for file in images[size])


def _check_lowest(listing: Listing, result: Checked) -> Iterator[Finding]:
    """Scans without labels that are one voxel late (see ``check_voxels``): their lowest layer is
    then the highest one, which the LiDAR does not reach."""
    if result.scans >= _ENOUGH and result.lowest == 0:
        message = f"none of {result.scans} scans has a voxel in the lowest layer"
        yield Finding("late", listing.name, f"sequences/{listing.name}/voxels", message, NOTE)
