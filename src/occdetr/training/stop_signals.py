"""SIGTERM and SIGUSR1, with which clusters announce that a run has to make room."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

import torch
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment

STOPPED = 75  # exit code; EX_TEMPFAIL of sysexits.h: try again later


class StoppedBySignal(SystemExit):
    """Ends a training that has written its checkpoint."""

    def __init__(self, number: int, code: int = STOPPED) -> None:
        super().__init__(code)
        self.name = signal.Signals(number).name


class StopSignals:
    """Notes the signals of a training until it is between two steps.

    Lightning's own handlers leave the loop without a checkpoint and start a broadcast wherever
    the process is. Only the requeueing of jobs is kept, Lightning's on SLURM or submitit's, and
    done once, after the checkpoint.
    """

    def __init__(self) -> None:
        self.noted = 0
        self.announcing: int = signal.SIGUSR1
        self.requeue: Any = None

    def watch(self, trainer: Any) -> None:
        """Handle the signals, in place of Lightning; ``Trainer`` restores what was there before."""
        if threading.current_thread() is not threading.main_thread():
            return
        environment = trainer._accelerator_connector.cluster_environment
        if "SUBMITIT_EXECUTOR" in os.environ:
            name = os.environ.get("SUBMITIT_PREEMPT_SIGNAL", "USR2")
            self.announcing = signal.Signals[f"SIG{name}"]
            self.requeue = signal.getsignal(self.announcing)
        elif isinstance(environment, SLURMEnvironment) and environment.auto_requeue:
            self.announcing = environment.requeue_signal or self.announcing
            self.requeue = signal.getsignal(self.announcing)
        for number in (signal.SIGTERM, signal.SIGUSR1, self.announcing):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.noted = number

    def agreed(self, trainer: Any) -> int:
        """The number of the signal that any of the processes has got, the same for all; or 0."""
        if trainer.world_size == 1:
            return self.noted
        noted = torch.tensor(self.noted, device=trainer.strategy.root_device)
        torch.distributed.all_reduce(noted, torch.distributed.ReduceOp.MAX)
        return int(noted)

    def stop(self, number: int) -> None:
        """Raises ``StoppedBySignal``."""
        code = STOPPED
        if callable(self.requeue) and number == self.announcing:
            try:
                self.requeue(number, None)
            except SystemExit as end:  # submitit's, which starts the job again by that code
                code = end.code if isinstance(end.code, int) else code
        raise StoppedBySignal(number, code)


def own_exit_code(trainer: Any) -> bool:
    """False in processes that Lightning has started: it kills the others if one of them fails."""
    launcher = trainer.strategy.launcher
    environment = getattr(launcher, "cluster_environment", None)
    started = environment is not None and not environment.creates_processes_externally
    return trainer.is_global_zero or not started
