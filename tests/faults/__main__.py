"""Inject every kind of fault and print what was lost: ``make faults``.

``report.json`` and ``report.md`` go to ``outputs/faults``. The exit code is 1 if anything was lost.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from rich.progress import Progress

from faults.bench import Bench, remove
from faults.caches import cache_cases
from faults.cases import Case, Report
from faults.machine import machine_cases
from faults.report import Table
from faults.trainings import training_cases
from faults.wrong_inputs import wrong_input_cases


def main() -> int:
    arguments = parsed()
    cases = every_case(arguments.kills)
    cases = [case for case in cases if arguments.only in f"{case.fault}\n{case.name}"]
    if not cases:
        sys.exit(f"--only {arguments.only!r}: there is no such case")
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="occdetr-faults-"))
    bench, table = Bench(folder), Table(arguments.seed)
    shared_before = shared_memory_without_owner()
    bench.prepare()
    with Progress() as bar, ThreadPoolExecutor(arguments.processes) as pool:
        task = bar.add_task("faults", total=len(cases))
        futures = {pool.submit(case.run, bench, arguments.seed): case for case in cases}
        for future in as_completed(futures):
            report: Report = future.result()
            table.add(futures[future], report)
            for text in report.lost:
                bar.console.print(f"LOST {text}", soft_wrap=True)
            bar.advance(task)
    table.shared_memory = len(shared_memory_without_owner() - shared_before)
    table.write(arguments.outputs)
    print(table)
    if table.lost:
        print(f"\nWhat was lost is kept in {folder}.")
        return 1
    if not arguments.folder:
        remove(folder)
    return 0


def shared_memory_without_owner() -> set[str]:
    """torch's files in ``/dev/shm`` whose process has ended; their names hold its number."""
    names = (path.name for path in Path("/dev/shm").glob("torch_*"))
    return {name for name in names if not Path(f"/proc/{name.split('_')[1]}").exists()}


def every_case(kills: int) -> list[Case]:
    return [
        *training_cases(kills),
        *cache_cases(kills),
        *machine_cases(max(kills // 25, 1)),
        *wrong_input_cases(),
    ]


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m faults", description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="of everything that is random")
    parser.add_argument("--kills", type=int, default=100, help="about how many in all")
    parser.add_argument("--only", default="", help="cases whose name or kind has this in it")
    parser.add_argument("--processes", type=int, default=2, help="cases at the same time")
    parser.add_argument("--folder", type=Path, help="to work in, kept; may hold streets already")
    parser.add_argument("--outputs", type=Path, default=Path("outputs/faults"))
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
