"""``prepare check=true``: the check of a data set, its table and ``check.json``."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from occdetr.cli import entry as cli
from occdetr.data.check_dataset import DatasetCheck, check_dataset
from occdetr.data.check_layout import ARCHIVES
from occdetr.data.datamodule import SceneDataModule
from occdetr.data.findings import ERROR, KINDS, NOTE, Group, first_fix, group_findings
from occdetr.data.frames import VOXEL_STRIDE
from occdetr.data.listing import FILES, Listing
from occdetr.data.processes import available_cores
from occdetr.errors import InputError
from occdetr.files import write_json

#: Exit code if training or evaluation could not run, as of predictions without some of the images.
FAULTY = 3
#: Headings of the table's columns; the other kinds have their own name.
HEADINGS = {"invalid": "in-\nvalid", "occluded": "oc-\ncluded", "velodyne": "velo-\ndyne"}
#: Kinds that have a column only where there is any.
RARE = ("velodyne", "labels")
#: Columns of a console that is none, as in a file or a pipe.
WIDTH = 120


def check_data(config: DictConfig, command: str) -> int:
    """Check the data set of ``config``, print what is there, and write ``check.json``.

    ``command`` prepares it. Returns the exit code: 0, or ``FAULTY`` if something is missing or
    corrupt that training or evaluation needs. Raises ``InputError`` if there is no data set.
    """
    datamodule = cli.build(config.data)
    makes_its_files = "write_workers" in config.data
    if makes_its_files and not datamodule.root.is_dir():
        raise InputError(f"data.root={datamodule.root}: there is no such folder: run {command}")
    workers = config.workers or available_cores()
    found = check_dataset(datamodule.folder, config.check_whole, workers)
    step = first_fix(found.findings, places(found))
    if step is not None and makes_its_files:
        step = f"delete the broken files, if there are any, and run {command}"
    broken = unusable_extra(datamodule)
    step = step or broken
    usable = found.usable and broken is None
    groups = group_findings(found.findings)
    report = {**run_report(found, datamodule.folder.stride, step or command), "usable": usable}
    file = cli.run_folder() / "check.json"
    write_json(file, report)
    print_check(found, groups)
    counts = [
        f"{count} {level}{'' if count == 1 else 's'}"
        for level in (ERROR, NOTE)
        for count in [sum(each.level == level for each in found.findings)]
    ]
    verdict = "can run" if usable else "cannot run, or would be wrong"
    print(
        f"training and evaluation {verdict}: {', '.join(counts)} in {cli.shown(file)}; "
        f"{found.whole} frames were read as a whole"
    )
    print(f"next: {step or command}")
    return 0 if usable else FAULTY


def unusable_extra(datamodule: SceneDataModule) -> str | None:
    """Why training could not use ``data.extra_roots``, None if it could. Their files are not read:
    check them as ``data.root``."""
    try:
        _ = datamodule.extra_frames
    except InputError as error:
        return str(error)
    return None


def places(found: DatasetCheck) -> dict[str, str]:
    """What ``Kind.fix`` names: the root, settings, and how to get each part of a sequence."""
    archives = [each.file for each in found.findings if each.kind == "archives"]
    words = {"root": str(found.root), "choose": other_sequences(found.listings)}
    numbers = [int(name) for each in found.listings if each.labelled for name in each.whole]
    words["stride"] = str(math.gcd(*numbers) or VOXEL_STRIDE)
    for part, (archive, source) in ARCHIVES.items():
        there = next((file for file in archives if Path(file).name == archive), None)
        file = found.root / there if there else f"{archive} from {source}"
        target = f"{found.root}/sequences/NN/{part}"
        words[f"get_{Path(part).stem}"] = f"unpack {file}, so that it gives {target}"
    return words


def other_sequences(listings: Sequence[Listing]) -> str:
    """Settings that do with the labelled sequences that are there; empty if these are too few."""
    there = [each for each in listings if each.labelled and each.complete]
    val = [int(each.name) for each in there if each.split == "val"]
    train = [int(each.name) for each in there if each.split != "val"]
    if not val and len(train) > 1:
        val.append(train.pop())
    if not (val and train):
        return ""
    numbers = {"train": train, "val": val}
    settings = [f"data.{split}_sequences={_list(each)}" for split, each in numbers.items()]
    return f", or do without: {' '.join(settings)}"


def _list(numbers: Sequence[int]) -> str:
    return f"[{','.join(map(str, numbers))}]"


def run_report(found: DatasetCheck, stride: int, step: str) -> dict[str, Any]:
    """The content of ``check.json``."""
    return {
        "root": str(found.root),
        "stride": stride,
        "usable": found.usable,
        "next": step,
        "frames_read_whole": found.whole,
        "sequences": {
            each.name: {
                "split": each.split,
                "frames": {"complete": len(each.complete), "expected": len(each.expected)},
                "files": {kind: len(names) for kind, names in each.found.items()},
                "lines": dict(each.lines),
                "calibration": each.calibration is not None,
                "images": {shown_size(s): n for s, n in found.images[each.name].items()},
            }
            for each in found.listings
        },
        "findings": [dataclasses.asdict(each) for each in found.findings],
    }


def print_check(found: DatasetCheck, groups: list[Group]) -> None:
    """Print a row for each sequence, and a line for each kind of finding."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    console.print(check_table(found))
    for group in groups:
        console.print(group_line(group), markup=False, highlight=False, soft_wrap=True)


def check_table(found: DatasetCheck) -> Table:
    """What each sequence has: the numbers of files, of lines, and of frames that can be used."""
    kinds = [
        kind for kind in FILES if kind not in RARE or any(e.found[kind] for e in found.listings)
    ]
    headings = ["", "split", *(HEADINGS.get(kind, kind) for kind in kinds), "calib", "poses"]
    table = Table(title=str(found.root), box=SIMPLE, pad_edge=False, collapse_padding=True)
    for heading in (*headings, "times", "frames", "errors"):
        right = heading not in ("", "split", "calib")
        table.add_column(heading, justify="right" if right else "left", no_wrap=True)
    for listing in found.listings:
        counts = [shown_count(len(listing.found[kind])) for kind in kinds]
        lines = [shown_count(listing.lines[file]) for file in ("poses.txt", "times.txt")]
        errors = sum(
            each.level == ERROR and each.sequence == listing.name for each in found.findings
        )
        calibration = shown_calibration(listing, found.images[listing.name])
        frames = f"{len(listing.complete)} of {len(listing.expected)}"
        row = [listing.name, listing.split or "-", *counts, calibration, *lines, frames]
        table.add_row(*row, shown_count(errors))
    return table


def group_line(group: Group) -> str:
    """One line for the findings of a kind: how many, where, and the first."""
    first, count = group.findings[0], len(group.findings)
    where = f" in {shown_sequences(group.sequences)}" if group.sequences else ""
    many = f" ({count}{where}), first" if count > 1 else ""
    return f"{group.level}: {KINDS[group.kind].title}{many}: {first.file}: {first.message}"


def shown_calibration(listing: Listing, images: Mapping[tuple[int, int], int]) -> str:
    """The size of a sequence's images, or whether it has a calibration."""
    if listing.calibration is None:
        return "bad" if (listing.path / "calib.txt").exists() else "-"
    sizes = sorted(images, key=lambda size: -images[size])
    more = " ..." if len(sizes) > 1 else ""
    return f"{shown_size(sizes[0])}{more}" if sizes else "yes"


def shown_sequences(names: Sequence[str]) -> str:
    """Sorted sequences with ranges, as in ``sequences 00-07, 09``."""
    runs: list[list[str]] = []
    for name in names:
        if runs and int(name) == int(runs[-1][-1]) + 1:
            runs[-1].append(name)
        else:
            runs.append([name])
    texts = [f"{run[0]}-{run[-1]}" if len(run) > 2 else ", ".join(run) for run in runs]
    return f"sequence{'s' if len(names) > 1 else ''} {', '.join(texts)}"


def shown_size(size: tuple[int, int]) -> str:
    return f"{size[1]}x{size[0]}"


def shown_count(count: int) -> str:
    return str(count) if count else "-"
