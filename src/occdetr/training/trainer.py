"""Lightning's Trainer as every entry point uses it: seeding, checkpoints, progress, Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sys
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import TensorBoardLogger

from occdetr.errors import InputError

LAST, BEST = "last", "best"  # names of the checkpoints, without .ckpt
MIB = 2**20


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


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the goal, then renames: a crash leaves the old checkpoint or the new one."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        goal = Path(path)
        goal.parent.mkdir(parents=True, exist_ok=True)
        temporary = goal.with_name(f".{goal.name}.{uuid.uuid4().hex}.tmp")
        try:
            torch.save(checkpoint, temporary)
            os.replace(temporary, goal)
        finally:
            temporary.unlink(missing_ok=True)


class EpochBar(TQDMProgressBar):
    """A bar that moves in a terminal; elsewhere (a file, CI) one line at the end of each epoch."""

    def __init__(self) -> None:
        super().__init__(refresh_rate=1 if sys.stdout.isatty() else 10**9)

    def get_metrics(self, *args: Any) -> Any:
        metrics = super().get_metrics(*args)
        metrics.pop("v_num", None)
        return metrics


def training_callbacks(folder: Path, monitor: str) -> list[Callback]:
    """``last.ckpt`` after each epoch, ``best.ckpt`` whenever a validation raises ``monitor``."""
    shared: dict[str, Any] = {
        "dirpath": folder,
        "enable_version_counter": False,
        "auto_insert_metric_name": False,
    }
    best = ModelCheckpoint(
        filename=BEST, monitor=monitor, mode="max", save_on_train_epoch_end=False, **shared
    )
    last = ModelCheckpoint(filename=LAST, save_on_train_epoch_end=True, **shared)
    return [best, last]


def computes_bf16(accelerator: str) -> bool:
    """Whether matrix products in bf16 are native here, and so several times faster."""
    if accelerator != "cpu" and torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # newer than torch 2.8
    return any(capabilities.get(name) for name in ("avx512_bf16", "amx_bf16"))


def resolve_precision(precision: Any, accelerator: str) -> Any:
    """``precision``, but for "auto": bf16-mixed where ``accelerator`` (a kind of device, such as
    cpu or cuda, or auto) computes in bf16, else 32-true."""
    if precision != "auto":
        return precision
    return "bf16-mixed" if computes_bf16(accelerator) else "32-true"


def peak_memory_mb(device: torch.device) -> float:
    """MiB: on a GPU the most that torch's allocator has held, else that this process has had."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / MIB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (MIB if sys.platform == "darwin" else 1024)  # the system counts KiB, macOS bytes


def make_trainer(
    folder: Path,
    settings: Mapping[str, Any],
    callbacks: Sequence[Callback] = (),
    log: bool = False,
) -> lightning.Trainer:
    """A Trainer with ``settings`` as its keywords; with ``log`` it writes TensorBoard files.

    ``precision`` may also be "auto" (``resolve_precision``).
    Raises ``InputError`` on settings that Lightning refuses.
    """
    if torch.cuda.is_available():
        torch.set_float32_matmul_precision("high")  # TF32
    bar = [EpochBar()] if settings.get("enable_progress_bar", True) else []
    keywords: dict[str, Any] = {
        "default_root_dir": folder,
        "logger": TensorBoardLogger(folder, name="", version="tensorboard") if log else False,
        "callbacks": [*callbacks, *bar],
        "plugins": [AtomicCheckpointIO()],
        "enable_checkpointing": bool(callbacks),
        "precision": resolve_precision(
            settings.get("precision"), settings.get("accelerator", "auto")
        ),
    }
    try:
        return lightning.Trainer(**{**settings, **keywords})
    except (MisconfigurationException, ValueError, TypeError) as error:
        raise InputError(f"trainer: {' '.join(str(error).split())}") from error


def run(trainer: lightning.Trainer, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """``method(*args, **kwargs)``, of ``trainer``, with Ctrl-C as KeyboardInterrupt.

    Lightning turns it into exit code 1, and ignores every further one.
    """
    try:
        return method(*args, **kwargs)
    except SystemExit:
        if not trainer.interrupted:
            raise
        signal.signal(signal.SIGINT, signal.default_int_handler)
        raise KeyboardInterrupt from None
    except MisconfigurationException as error:
        raise InputError(f"trainer: {' '.join(str(error).split())}") from error
