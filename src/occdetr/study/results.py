"""Generate the tables and curves of all studies: ``python -m occdetr.study.results``."""

from __future__ import annotations

import os
import re
import shlex
import statistics
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from occdetr.cli import entry as cli
from occdetr.drawing.curves import Curve, draw_curves
from occdetr.errors import InputError
from occdetr.files import check_folder, write_atomically
from occdetr.study.plan import read_study
from occdetr.study.record import read_record
from occdetr.study.tables import CURVES, TABLES, Records, mean_curve

END = "<!-- end -->"
WIDTH = 120  # columns of a line of prose
MARKER = re.compile(rf"^<!-- ((?:[\w-]+/)*(?:{'|'.join(TABLES)})) -->$", re.MULTILINE)


@cli.entry_point("results", takes_folder=False)
def main(config: DictConfig) -> None:
    """Write the tables between the markers of the page, and one picture per study."""
    page, images = Path(config.page), Path(config.images)
    if not Path(config.results).is_dir():
        raise InputError(
            f"results={config.results}: no such folder, so that no table would stay: give the "
            "folder that holds the studies' records"
        )
    check_folder("images", images, writable=True)
    text = _read_page(page)
    for name in block_names(text):
        study = name.split("/")[-1]
        plan = read_study(study)
        records = read_records(Path(config.results) / name, plan)
        missing = missing_runs(records, plan["seeds"])
        picture = images / f"{name.replace('/', '-')}.png"
        lines = block_lines(study, records, missing)
        runs = all_runs(records)
        if study in CURVES and runs:
            write_atomically(picture, curves(study, records))
            link = Path(os.path.relpath(picture, page.parent)).as_posix()
            lines += ["", f"![{study} during training]({link})"]
        text = replace_block(text, name, lines, page)
        print(f"{name}: {len(runs)} results{missing_line(missing, '; missing: ')}")
    write_atomically(page, text.encode())
    print(f"done: {cli.shown(page)}")


def _read_page(page: Path) -> str:
    try:
        return page.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"page={page}: is not a text in UTF-8: give a Markdown file") from None


def block_names(text: str) -> list[str]:
    """Folders of records that a page shows, relative to the folder of results.

    These are the folders of all studies, and those of studies with other settings
    (``larger/convergence``) for which ``text`` has a marker.
    """
    return [*TABLES, *(name for name in MARKER.findall(text) if name not in TABLES)]


def read_records(folder: Path, plan: Mapping[str, Any]) -> dict[str, dict[int, dict[str, Any]]]:
    """All records in ``folder``, by arm in the order of ``plan`` (``read_study``), then by seed.

    Raises ``InputError`` if a file is not a record of one of the arms.
    """
    found: dict[str, dict[int, dict[str, Any]]] = {arm: {} for arm in plan["arms"]}
    for path in sorted(folder.glob("*.json")):
        name = re.fullmatch(r"(.+)_seed(0|[1-9][0-9]*)", path.stem)
        if name is None or name[1] not in found:
            raise InputError(
                f"{path}: is no record of an arm of {folder.name} ({', '.join(found)}): "
                "rename it to <arm>_seed<k>.json, or move it elsewhere"
            )
        arm, seed = name[1], int(name[2])
        found[arm][seed] = read_record(path, arm, seed, plan)
    return {arm: dict(sorted(by_seed.items())) for arm, by_seed in found.items()}


def all_runs(records: Records) -> list[Mapping[str, Any]]:
    """The records of all arms and seeds in one list."""
    return [run for by_seed in records.values() for run in by_seed.values()]


def missing_runs(records: Records, seeds: list[int]) -> dict[str, list[int]]:
    """Seeds without a record, by arm; arms without missing seeds are left out."""
    missing = {
        arm: [seed for seed in seeds if seed not in by_seed] for arm, by_seed in records.items()
    }
    return {arm: without for arm, without in missing.items() if without}


def missing_line(missing: Mapping[str, list[int]], start: str) -> str:
    """``start`` and a list of the missing runs; an empty string if none is missing."""
    parts = [f"{arm} seed {', '.join(map(str, seeds))}" for arm, seeds in missing.items()]
    return f"{start}{'; '.join(parts)}" if parts else ""


def block_lines(study: str, records: Records, missing: Mapping[str, list[int]]) -> list[str]:
    """The Markdown lines of a study: commands, origin, missing runs, tables."""
    runs = all_runs(records)
    if not runs:
        return [f"No results yet: `python -m occdetr.study name={study}`."]
    commands = _joined({f"`{_command(run)}`" for run in runs})
    lines = _wrapped(f"{commands}; {origin(records)}.")
    if missing:
        lines += ["", *_wrapped(missing_line(missing, "Missing: ") + ".")]
    return [*lines, "", *TABLES[study](records)]


def origin(records: Records) -> str:
    """Number of runs, commits, generator versions, models and machines of the records."""
    runs = all_runs(records)
    commits = {_commit(run) for run in runs}
    versions = {f"generator version {v}" for run in runs if (v := run["generator_version"])}
    models = {f"`model={run['model']}`" for run in runs}
    machines = {_machine(run["machine"]) for run in runs}
    facts = [f"{len(runs)} runs", *map(_joined, (commits, versions, models, machines))]
    return "; ".join(fact for fact in facts if fact)


def _machine(facts: Mapping[str, Any]) -> str:
    cores = f"{facts['cores']} core{'' if facts['cores'] == 1 else 's'}"
    rest = f"{facts['device']}, torch {facts['torch']}, {facts['precision']}"
    return f"{facts['cpu']}, {cores}, {rest}"


def _command(run: Mapping[str, Any]) -> str:
    """The command of the whole study, without the overrides that selected this one run."""
    words = shlex.split(run["command"])
    kept = (word for word in words if not word.startswith(("arms=", "seeds=", "rebuild=")))
    # A space after each comma of a list, so that the line can be wrapped there.
    return " ".join(f'"{word}"'.replace("','", "', '") if "'" in word else word for word in kept)


def _wrapped(paragraph: str) -> list[str]:
    """Lines of at most ``WIDTH`` columns; words and options stay whole."""
    return textwrap.wrap(paragraph, WIDTH, break_long_words=False, break_on_hyphens=False)


def _commit(run: Mapping[str, Any]) -> str:
    commit = f"commit {run['commit'][:7]}" if run["commit"] else "outside a repository"
    # The commit identifies the code only if there were no uncommitted changes.
    code = "" if run["dirty"] is False else f", code {run['code']}"
    return f"{commit}{code}{' (changed while it ran)' if run['code_changed'] else ''}"


def _joined(facts: set[str]) -> str:
    return " and ".join(sorted(facts))


def curves(study: str, records: Records) -> bytes:
    """The plot of a study as PNG: thick lines for means over seeds, thin ones for single seeds.

    The x axis counts the steps of the last stage, since not every arm has the one before.
    """
    panels = {
        name: {
            arm: seed_curves(mean_curve(by_seed, key))
            for arm, by_seed in records.items()
            if by_seed
        }
        for key, name in CURVES[study].items()
    }
    last = {list(run["stages"])[-1] for run in all_runs(records)}
    return draw_curves(panels, f"steps of stage={', '.join(sorted(last))}", study)


def seed_curves(values: Mapping[int, Sequence[float]]) -> Curve:
    """The mean and the single seeds, in per cent; ``values`` of all seeds, by step."""
    seeds = zip(*values.values(), strict=True)
    return Curve(
        [(step, 100 * statistics.mean(each)) for step, each in values.items()],
        [[(step, 100 * v) for step, v in zip(values, seed, strict=True)] for seed in seeds],
    )


def replace_block(text: str, name: str, lines: list[str], page: Path) -> str:
    """``text`` with ``lines`` between the marker of ``name`` and the end marker after it.

    Raises ``InputError`` if one of the markers is missing.
    """
    marker = f"<!-- {name} -->"
    before, found, rest = text.partition(f"{marker}\n")
    old, ended, after = rest.partition(END)
    if not found or not ended or MARKER.search(old):
        raise InputError(f"{page}: needs a line {marker} and a line {END} after it: add them")
    return f"{before}{marker}\n" + "\n".join(lines) + f"\n{END}{after}"


if __name__ == "__main__":
    main()
