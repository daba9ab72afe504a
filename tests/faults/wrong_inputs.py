"""Every malformed input of the generators in ``tests``, given to its entry point."""

from __future__ import annotations

import random
import threading
from dataclasses import dataclass
from pathlib import Path

from faults.bench import Bench, temporary_files
from faults.cases import Case, Lost, Report, check_user_error, note_remains
from faults.processes import start
from malformed import Malformed, malformed_inputs
from malformed_settings import malformed_settings

#: Seconds after which a program counts as hanging.
PATIENCE = 120.0

_MAKING = threading.Lock()  # Hydra composes one configuration at a time


@dataclass(frozen=True)
class Refusal:
    """The program must end with one of the input's exit codes, a line for each error, without a
    traceback, and leave no file that is half written."""

    wrong: Malformed

    def __call__(self, bench: Bench, generator: random.Random, place: Path, report: Report) -> None:
        (place / "input").mkdir(parents=True)
        with _MAKING:
            given = self.wrong.make(place / "input")
        run = start(self.wrong.command, given, place / "logs" / "run")
        run.wait(PATIENCE)
        check_user_error(run, self.wrong.codes)
        report.injected += 1
        note_remains([run], place, report)
        half = temporary_files(place)
        if half:
            raise Lost(f"{half[0]} is left")


def wrong_input_cases() -> list[Case]:
    every = [*malformed_inputs(), *malformed_settings()]
    return [Case(f"malformed: {e.kind}", f"malformed: {e.name}", Refusal(e)) for e in every]
