"""The table of what was injected and what was lost."""

from __future__ import annotations

import dataclasses
import json
import platform
from pathlib import Path
from typing import Any

import torch

from faults.cases import Case, Report

HEAD = ("fault", "times", "lost", "orphans", "temporary files", "seconds", "command")


class Table:
    """The reports of all cases, added up by the kind of fault."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.shared_memory = 0
        self.rows: dict[str, Report] = {}

    def add(self, case: Case, report: Report) -> None:
        self.rows.setdefault(case.fault, Report()).add(report)

    @property
    def lost(self) -> list[str]:
        return [text for report in self.rows.values() for text in report.lost]

    def write(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.json").write_text(json.dumps(self.content(), indent=2) + "\n")
        (folder / "report.md").write_text(f"{self}\n")

    def content(self) -> dict[str, Any]:
        return {
            "seed": self.seed,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "shared_memory_left": self.shared_memory,
            "rows": {fault: dataclasses.asdict(report) for fault, report in self.rows.items()},
        }

    def __str__(self) -> str:
        rows = [self._row(fault, report) for fault, report in sorted(self.rows.items())]
        lines = [HEAD, ("---",) * len(HEAD), *rows]
        table = [f"| {' | '.join(str(cell) for cell in line)} |" for line in lines]
        repeat = [f"- {text}" for text in self.lost]
        left = f"Files left in shared memory: {self.shared_memory}."
        return "\n".join([*table, "", left, *repeat])

    def _row(self, fault: str, report: Report) -> tuple[Any, ...]:
        command = f"`make faults FAULTS=\"--seed {self.seed} --only '{fault}'\"`"
        lost = len(report.lost) or "nothing"
        seconds = round(report.seconds)
        return fault, report.injected, lost, report.orphans, report.temporary, seconds, command
