"""Processes of one run that were started from outside, as by ``torchrun``, ``srun`` or submitit.

Lightning starts the ranks of a machine itself and gives them the folder of the first one. Ranks
that others start read the clock on their own, and each would make a folder.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.utilities.rank_zero import rank_zero_only
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from occdetr.errors import InputError

FOLDER, JOINED, OVERRIDE = "occdetr_run_folder", "occdetr_joined", "hydra.run.dir="
SWEEP = {"-m", "--multirun"}


@dataclass(frozen=True)
class OutsideRanks:
    """This process among those of its run; ``store`` is what they share."""

    rank: int
    world_size: int
    store: Any

    def take_folder(self) -> None:
        """On further ranks, wait for the first one's folder, and make it this program's.

        Raises ``InputError`` if the first one ends before it has one, and for a sweep.
        """
        if SWEEP & set(sys.argv):
            raise InputError(
                "-m: ranks started from outside make one run: start each run by itself"
            )
        if self.rank == 0:
            return
        quoted = self.folder().replace("\\", "\\\\").replace("'", "\\'")
        sys.argv[1:] = [text for text in sys.argv[1:] if not text.startswith(OVERRIDE)]
        sys.argv.append(f"{OVERRIDE}'{quoted}'")

    def folder(self) -> str:
        """The first rank's folder, when it has one.

        Raises ``InputError`` if the first one ends before it has one.
        """
        try:
            return self.store.get(FOLDER).decode()
        except (RuntimeError, ValueError) as error:
            raise InputError("rank 0 has ended or is not there: see its own message") from error

    def give_folder(self, folder: Path) -> None:
        """On the first rank, tell the others; on all, form the group that Lightning will use.

        The first rank, which has the store, goes on when all have joined: if it ended before, the
        others would fail with a message about a lost connection.
        """
        if self.rank == 0:
            self.store.set(FOLDER, str(folder.resolve()))
        group = PrefixStore("occdetr", self.store)
        torch.distributed.init_process_group(
            store=group, rank=self.rank, world_size=self.world_size
        )
        self.store.set(f"{JOINED}/{self.rank}", "")
        if self.rank == 0:
            self.store.wait([f"{JOINED}/{rank}" for rank in range(self.world_size)])


def name_local_tasks() -> None:
    """Give the tasks of a job of submitit on this machine the variables of ``torchrun``.

    Those of a job on SLURM have SLURM's. Lightning has read its rank when it was imported.
    """
    tasks = int(os.environ.get("SUBMITIT_LOCAL_NTASKS", 1))
    if os.environ.get("SUBMITIT_EXECUTOR") != "local" or tasks == 1:
        return
    rank = os.environ["SUBMITIT_LOCAL_GLOBALID"]
    port = 20_000 + int(os.environ["SUBMITIT_LOCAL_JOB_ID"]) % 40_000
    group = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": str(tasks)}
    os.environ.update({**group, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)})
    rank_zero_only.rank = int(rank)


def outside_ranks() -> OutsideRanks | None:
    """None in a process of its own, and in those that Lightning has started.

    Raises ``InputError`` if SLURM's settings are not those that Lightning needs.
    """
    with warnings.catch_warnings():
        if SWEEP & set(sys.argv):  # its jobs are started by srun, if it says so
            warnings.simplefilter("ignore")
        on_slurm = SLURMEnvironment.detect()
    if on_slurm:
        try:
            slurm = SLURMEnvironment()
        except RuntimeError as error:
            raise InputError(f"SLURM: {' '.join(str(error).split())}") from error
        os.environ["MASTER_ADDR"] = slurm.main_address
        os.environ["MASTER_PORT"] = str(slurm.main_port)
        rank, world_size = slurm.global_rank(), slurm.world_size()
    elif {"RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"} <= os.environ.keys():
        rank, world_size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    else:
        return None
    if world_size == 1:
        return None
    if rank == 0:
        others = world_size - 1
        print(f"ranks: waiting for {others} more, that srun or torchrun starts", flush=True)
    found: Iterator[Any] = rendezvous("env://", rank, world_size)
    store, _, _ = next(found)
    return OutsideRanks(rank, world_size, store)
