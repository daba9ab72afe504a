"""What a training starts from: an interrupted run (``resume``) or weights (``init_from``)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from occdetr.cli.entry import shown
from occdetr.errors import InputError
from occdetr.training.checkpoint import Checkpoint, check_targets, read_checkpoint
from occdetr.training.compare_settings import changes, check_same_model, select
from occdetr.training.find_checkpoint import (
    check_resumable,
    other_overrides,
    pretraining_for,
    run_to_resume,
    whole_checkpoint,
)
from occdetr.training.run_checkpoint import LAST
from occdetr.training.trainer import is_main_process


def starting_point(settings: dict[str, Any]) -> tuple[Checkpoint | None, Checkpoint | None]:
    """The checkpoints to resume from and to take weights from; prints which.

    Raises ``InputError`` if a checkpoint is not there or does not fit.
    """
    stage, initial, resume = (settings[key] for key in ("stage_name", "init_from", "resume"))
    overrides = HydraConfig.get().overrides.task
    other = f"stage={stage}" if stage == "pretrain" else f"resume={resume}"
    unused = other not in ("resume=None", "resume=allow") and initial != "auto"
    if unused and f"init_from={initial}" in overrides:
        remedy = "leave one of them out"
        if stage != "pretrain":
            remedy += ", or give resume=allow to start from it where there is no run to resume"
        raise InputError(f"init_from={initial}: {other} does not use it: {remedy}")
    if resume is not None:
        checkpoint = resumed_run(settings)
        if checkpoint is not None:
            say(f"resuming: {shown(checkpoint.path)}")
            return checkpoint, None
    if stage == "pretrain" or initial == "scratch":
        return None, None
    found = pretraining_for(settings, overrides) if initial == "auto" else Path(initial)
    checkpoint = read_checkpoint(found)
    check_targets(checkpoint, settings)
    check_same_model(checkpoint.config, settings, f"init_from={found}")
    others = other_overrides(found, overrides) if initial == "auto" else ""
    say(f"starting from: {shown(found)}{f' (other than this run, {others})' if others else ''}")
    old, new = (select(each, "image_size") for each in (checkpoint.config, settings))
    if old != new:
        kept = f"image_size={old}".replace(" ", "")
        say(f"note: it was trained with {kept}, this run has {new}: give {kept} to keep it")
    return None, checkpoint


def resumed_run(settings: dict[str, Any]) -> Checkpoint | None:
    """What ``resume`` names; None if it may be nothing (allow)."""
    stage, resume = settings["stage_name"], settings["resume"]
    damaged: list[str] = []
    if resume in ("auto", "allow"):
        found = run_to_resume(settings, damaged.append, of_sweep=in_sweep())
        reason = (
            f"resume={resume}: no run of stage={stage} model={settings['model_name']} with these "
            f"settings below {Path(settings['outputs']) / stage}"
        )
        if found is None and resume == "auto":
            text = f" ({'; '.join(damaged)})" if damaged else ""
            raise InputError(f"{reason}{text}: leave resume out, or give resume=<checkpoint>")
        _warn_of(damaged)
        if found is None:
            say(f"{reason}: starting anew")
            return None
    elif Path(resume).is_dir():
        found = whole_checkpoint(Path(resume), damaged.append)
        if found is None:
            text = f" ({'; '.join(damaged)})" if damaged else ""
            reason = f"no whole {LAST} in this folder{text}"
            raise InputError(f"resume={resume}: {reason}: give another one")
        _warn_of(damaged)
    else:
        found = read_checkpoint(resume)
    if found.stage != stage:
        raise InputError(
            f"resume={resume}: it is of stage={found.stage}: give stage={found.stage}, "
            f"or start stage={stage} from its weights with init_from={found.path}"
        )
    check_targets(found, settings)
    check_resumable(found, settings, f"resume={resume}")
    for path, old, new in changes(found.config, settings):
        say(f"resume: {path} {old} -> {new}")
    return found


def in_sweep() -> bool:
    """Whether this is a job of a sweep (``-m``)."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def say(line: str) -> None:
    """Print a line, on one of the processes of a run."""
    if is_main_process():
        print(line, flush=True)


def warn(line: str) -> None:
    """The same on stderr, as a warning."""
    if is_main_process():
        print(f"warning: {line}", file=sys.stderr, flush=True)


def _warn_of(damaged: Sequence[str]) -> None:
    for line in damaged:
        warn(f"{line}; it was passed over")
