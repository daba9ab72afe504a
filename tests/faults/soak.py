"""A long training whose memory, handles, disk and seconds a step are sampled and drawn.

``python -m faults.soak --minutes 120`` trains ``stage=full`` of the smallest model on the demo's
streets in a process of its own; further arguments are settings of ``occdetr.train``. What was
sampled so far is drawn on Ctrl-C too, and again by ``--draw``. The exit code is 1 if a quantity
grew. Linux only.

``samples.csv``, ``soak.json`` and ``soak.png`` go to ``outputs/soak``.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from faults.growth import draw, table, trends

SETTINGS = (
    *("stage=full", "init_from=scratch", "model=tiny", "data=synthetic_demo", "trainer=cpu"),
    *("trainer.max_epochs=100000", "trainer.log_every_n_steps=1"),
)
MIB = 2**20


def main() -> int:
    arguments, settings = parsed()
    folder: Path = arguments.outputs
    if not arguments.draw:
        observe(folder, settings, arguments.minutes * 60, arguments.every)
    found = trends(folder)
    (folder / "soak.json").write_text(json.dumps([vars(each) for each in found], indent=2) + "\n")
    (folder / "soak.png").write_bytes(draw(found, folder))
    print(table(found) if found else "too few samples for a trend")
    return 0 if all(each.flat for each in found) else 1


def observe(folder: Path, settings: list[str], seconds: float, every: float) -> None:
    """Train for ``seconds``, sample meanwhile, and end the training by SIGTERM."""
    run = folder / "run"
    if run.exists():
        sys.exit(f"{run} exists: remove it, give another --outputs, or --draw what is there")
    folder.mkdir(parents=True, exist_ok=True)
    prepare(folder / "prepare", settings)
    command = [sys.executable, "-m", "occdetr.train", *SETTINGS, *settings, f"hydra.run.dir={run}"]
    with (folder / "training.log").open("w") as log:
        training = subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
    try:
        _sample_until(training, folder, time.monotonic() + seconds, every)
    except KeyboardInterrupt:
        print("interrupted: drawing what was sampled")
    finally:
        if training.poll() is None:
            training.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                training.wait(120)
        training.kill()
        print(f"the training ended with exit code {training.wait()}; log: {folder}/training.log")


def prepare(run: Path, settings: list[str]) -> None:
    """Write streets and labels that are missing, whose time is not that of the training."""
    data = [text for text in settings if text.partition("=")[0].partition(".")[0] == "data"]
    data = ["data=synthetic_demo", *data, f"hydra.run.dir={run}"]
    subprocess.run([sys.executable, "-m", "occdetr.prepare", *data], check=True)


def _sample_until(
    training: subprocess.Popen[bytes], folder: Path, end: float, every: float
) -> None:
    began = time.monotonic()
    with (folder / "samples.csv").open("w", newline="") as file:
        writer: csv.DictWriter[str] | None = None
        while time.monotonic() < end and training.poll() is None:
            sample = {"seconds": round(time.monotonic() - began, 2), "time": round(time.time(), 2)}
            sample |= sampled(training.pid, folder / "run")
            if writer is None:
                writer = csv.DictWriter(file, sample)
                writer.writeheader()
            writer.writerow(sample)
            file.flush()
            time.sleep(every)


def sampled(session: int, run: Path) -> dict[str, float]:
    """Memory, handles and threads of the processes of a session, and the disk that a run takes.

    Memory is in MiB: resident of the main process, and the proportional share (PSS) of all, in
    which pages that processes share count once.
    """
    processes = list(_session(session))
    return {
        "processes": len(processes),
        "main memory": round(_kib(Path(f"/proc/{session}/smaps_rollup"), "Rss") / 1024, 1),
        "memory": round(sum(_kib(each / "smaps_rollup", "Pss") for each in processes) / 1024, 1),
        "handles": sum(_count(each / "fd") for each in processes),
        "threads": sum(_count(each / "task") for each in processes),
        "disk": round(sum(_size(path) for path in run.rglob("*")) / MIB, 2),
    }


def _session(session: int) -> Iterator[Path]:
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[3]) == session:
                yield stat.parent


def _kib(file: Path, name: str) -> int:
    with contextlib.suppress(OSError):
        for line in file.read_text().splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1])
    return 0


def _count(folder: Path) -> int:
    with contextlib.suppress(OSError):
        return len(list(folder.iterdir()))
    return 0


def _size(path: Path) -> int:
    with contextlib.suppress(OSError):
        return path.lstat().st_blocks * 512
    return 0


def parsed() -> tuple[argparse.Namespace, list[str]]:
    parser = argparse.ArgumentParser(
        prog="python -m faults.soak",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--minutes", type=float, default=120.0, help="of the training")
    parser.add_argument("--every", type=float, default=5.0, help="seconds between two samples")
    parser.add_argument("--outputs", type=Path, default=Path("outputs/soak"))
    parser.add_argument("--draw", action="store_true", help="only draw what was sampled before")
    return parser.parse_known_args()


if __name__ == "__main__":
    sys.exit(main())
