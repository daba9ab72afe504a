"""Make and cache all object labels: ``python -m occdetr.prepare data=... data.root=...``.

``check=true`` checks the data set instead, and writes nothing to it.
"""

from __future__ import annotations

import sys
import time

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from occdetr.cli import entry as cli
from occdetr.cli.data_check import check_data
from occdetr.cli.overrides import command_line
from occdetr.cli.shards import parse_shard
from occdetr.data.frames import LABELLED_SPLITS
from occdetr.data.preparation import LABEL_STEPS, STEPS, FrameResult, PreparationResult
from occdetr.data.processes import available_cores
from occdetr.errors import InputError
from occdetr.files import write_json

TABLE_ROWS = {
    "reading": "reading files",
    "clustering": "clustering",
    "visibility": "visibility (ray casting)",
    "boxes": "boxes",
    "writing": "writing",
    "object_labels": "object labels: clustering + visibility + boxes",
}


@cli.entry_point("prepare")
def main(config: DictConfig) -> None:
    """Write synthetic streets if they are missing, label all frames, write ``prepare.json``."""
    refuse_unused(config.check)
    if config.check:
        sys.exit(check_data(config, own_command("occdetr.prepare")))
    shard = parse_shard(config.shard)
    workers = config.workers or available_cores()
    datamodule = cli.build(config.data)
    datamodule.prepare_data()
    print(datamodule.training_summary(), datamodule.summary("val"), sep="\n", flush=True)
    frames: list[FrameResult] = []
    began = time.perf_counter()
    try:
        done = datamodule.prepare_objects(
            LABELLED_SPLITS, workers, shard=shard, rebuild=config.rebuild, on_frame=frames.append
        )
    except KeyboardInterrupt:
        so_far = PreparationResult(frames, time.perf_counter() - began)
        how = " without rebuild=true" if config.rebuild else ""
        print(f"stopped after {_counts(so_far)}: run it again{how} to continue")
        raise
    seconds = seconds_per_frame(done)
    report = {
        "root": str(datamodule.root),
        "cache": str(datamodule.labels.root),
        "partition": config.partition_name,
        "shard": config.shard,
        "frames": len(done.frames),
        "built": done.built,
        "reused": done.reused,
        "objects": done.objects,
        "seconds": round(done.seconds, 3),
        "frames_per_second": round(_rate(done), 2),
        "workers": workers,
        "seconds_per_frame": seconds,
    }
    write_json(cli.run_folder() / "prepare.json", report)
    if done.built:
        _print_table(seconds, done.built)
    print(
        f"done: {_counts(done)}, {done.objects} objects, {_rate(done):.1f} frames/s; "
        f"next: {own_command('occdetr.train', 'stage=pretrain')}"
    )


def refuse_unused(check: bool) -> None:
    """Raises ``InputError`` for a setting that has no effect with or without the check."""
    unused = ("shard", "rebuild") if check else ("check_whole",)
    for text in HydraConfig.get().overrides.task:
        if text.partition("=")[0].lstrip("+") in unused:
            only = "not for check=true" if check else "only for check=true"
            raise InputError(f"{text}: {only}: leave it out")


def own_command(module: str, *settings: str) -> str:
    """A command on the same data and partition, to be pasted into a shell."""
    own = ("shard=", "workers=", "rebuild=", "check=", "check_whole=", "hydra.")
    given = [text for text in HydraConfig.get().overrides.task if not text.startswith(own)]
    return command_line(module, [*settings, *given])


def seconds_per_frame(done: PreparationResult) -> dict[str, float | None]:
    """Median seconds of each step, and of making the labels without reading files."""
    groups = {**{step: (step,) for step in STEPS}, "object_labels": LABEL_STEPS}
    medians = {name: done.median_seconds(steps) for name, steps in groups.items()}
    return {name: None if s is None else round(s, 5) for name, s in medians.items()}


def _counts(done: PreparationResult) -> str:
    return f"{len(done.frames)} frames ({done.built} built, {done.reused} already there)"


def _rate(done: PreparationResult) -> float:
    return len(done.frames) / max(done.seconds, 1e-9)


def _print_table(seconds: dict[str, float | None], frames: int) -> None:
    table = Table(title=f"seconds per frame, median of {frames} built")
    table.add_column("step")
    table.add_column("s", justify="right")
    for name, row in TABLE_ROWS.items():
        if name == "object_labels":
            table.add_section()
        table.add_row(row, f"{seconds[name]:.4f}")
    Console().print(table)


if __name__ == "__main__":
    main()
