"""Lightning's Trainer as the entry points use it: seeding, checkpoints, progress, Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import lightning
import torch
from lightning.fabric.plugins import CheckpointIO
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.callbacks import (
    Callback,
    Checkpoint,
    ProgressBar,
    TQDMProgressBar,
)
from lightning.pytorch.loggers import Logger

from occdetr.errors import InputError
from occdetr.training.device import check_devices
from occdetr.training.precision import resolve_precision
from occdetr.training.run_checkpoint import AtomicCheckpointIO
from occdetr.training.settings import check_trainer, explain_trainer
from occdetr.training.stop_signals import StoppedBySignal

T = TypeVar("T")


def seed_everything(seed: int) -> None:
    """Seed Python, NumPy, torch and the data workers."""
    lightning.seed_everything(seed, workers=True, verbose=False)


def is_main_process() -> bool:
    """False on the further ranks of a distributed run, which neither print nor write results."""
    return rank_zero_only.rank in (None, 0) and int(os.environ.get("LOCAL_RANK", 0)) == 0


@contextlib.contextmanager
def own_ranks() -> Iterator[None]:
    """Further ranks last for one job: the next job of a sweep starts its own.

    Lightning leaves the process group and its variables behind, and would wait for ranks that have
    ended.
    """
    names = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK", "LOCAL_RANK", "WORLD_SIZE")
    before = {name: os.environ.get(name) for name in names}
    yield
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
    for name, value in before.items():
        os.environ.pop(name, None)
        if value is not None:
            os.environ[name] = value


class EpochBar(TQDMProgressBar):
    """A bar that moves in a terminal; elsewhere (a file, CI) one line at the end of each epoch."""

    def __init__(self) -> None:
        super().__init__(refresh_rate=1 if sys.stdout.isatty() else 10**9)

    def get_metrics(self, *args: Any) -> Any:
        metrics = super().get_metrics(*args)
        metrics.pop("v_num", None)
        return metrics


def make_trainer(
    trainer: partial[lightning.Trainer],
    folder: Path,
    callbacks: Sequence[Callback] = (),
    loggers: Sequence[Logger] = (),
) -> lightning.Trainer:
    """The Trainer that ``trainer`` constructs, with more callbacks and loggers.

    Callbacks, loggers and plugins among the keywords of ``trainer`` are used too; ``logger=False``
    there means none at all. ``precision`` may also be "auto" (``resolve_precision``).

    Raises ``InputError`` on settings that Lightning refuses.
    """
    given = trainer.keywords
    check_trainer(given)
    check_devices(given.get("accelerator", "auto"), given.get("devices"))
    every = [*callbacks, *listed("trainer.callbacks", given.get("callbacks"), Callback)]
    if given.get("enable_progress_bar", True) and not _has(every, ProgressBar):
        every.append(EpochBar())
    plugins = listed("trainer.plugins", given.get("plugins"), object)
    if not _has(plugins, CheckpointIO):
        plugins.append(AtomicCheckpointIO())
    keywords: dict[str, Any] = {
        "default_root_dir": given.get("default_root_dir") or folder,
        "logger": _loggers(loggers, given.get("logger")),
        "callbacks": every,
        "plugins": plugins,
        "precision": resolve_precision(given.get("precision"), given.get("accelerator", "auto")),
    }
    if given.get("enable_checkpointing") is None:
        keywords["enable_checkpointing"] = _has(every, Checkpoint)
    if torch.cuda.is_available():
        torch.set_float32_matmul_precision("high")  # TF32
    try:
        made = trainer(**keywords)
    except (MisconfigurationException, ImportError, ValueError, TypeError) as error:
        raise InputError(explain_trainer(given, str(error))) from error
    _check_tasks(made)
    grouped = torch.distributed.is_available() and torch.distributed.is_initialized()
    if grouped and torch.distributed.get_world_size() != made.world_size:
        raise InputError(
            f"trainer.devices: {torch.distributed.get_world_size()} ranks were started, "
            f"{made.world_size} are configured: give trainer=ddp trainer.devices=<ranks of one "
            "machine> trainer.num_nodes=<machines>"
        )
    return made


def _check_tasks(made: Any) -> None:
    """Lightning compares its ranks with the tasks of SLURM when the data is there already."""
    environment = made._accelerator_connector.cluster_environment
    if made.strategy.launcher is None or environment is None:
        return
    try:
        environment.validate_settings(num_devices=made.num_devices, num_nodes=made.num_nodes)
    except ValueError as error:
        raise InputError(
            f"trainer.devices={made.num_devices} trainer.num_nodes={made.num_nodes}: "
            f"{' '.join(str(error).split())} A rank is a task: give --ntasks-per-node=<devices> "
            "and --nodes=<num_nodes>, and start them with srun"
        ) from error


def listed(setting: str, value: Any, kind: type[T]) -> list[T]:
    """The objects that a setting holds: none, one, a list, or a dictionary of them by name.

    Raises ``InputError`` if one is of another kind.
    """
    if value is None:
        return []
    if isinstance(value, Mapping):
        value = list(value.values())
    found = list(value) if isinstance(value, (list, tuple)) else [value]
    for each in found:
        if not isinstance(each, kind):
            raise InputError(
                f"{setting}={value}: {each!r} is no {kind.__name__}: give nodes with _target_, or "
                "choose by name, as in callbacks=[default,early_stopping] or logger=csv"
            )
    return found


def _loggers(chosen: Sequence[Logger], given: Any) -> list[Logger] | bool:
    if given is False:
        return False
    return [*chosen, *listed("trainer.logger", None if given is True else given, Logger)] or False


def _has(objects: Sequence[Any], kind: type) -> bool:
    return any(isinstance(each, kind) for each in objects)


def run(trainer: lightning.Trainer, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """``method(*args, **kwargs)``, of ``trainer``, with Ctrl-C as KeyboardInterrupt.

    Lightning turns it into exit code 1, and ignores every further one.
    """
    try:
        return method(*args, **kwargs)
    except StoppedBySignal:
        raise
    except SystemExit:
        if not trainer.interrupted:
            raise
        signal.signal(signal.SIGINT, signal.default_int_handler)
        raise KeyboardInterrupt from None
    except MisconfigurationException as error:
        raise InputError(f"trainer: {' '.join(str(error).split())}") from error
    except (ValueError, RuntimeError) as error:
        message = " ".join(str(error).split())
        if "`val_check_interval`" in message or message.startswith("Early stopping conditioned"):
            raise InputError(f"trainer: {message}") from error
        raise
