"""A job of a sweep in a process of its own, which a launcher (joblib, submitit) has started.

The launcher hands over the function that ``entry.entry_point`` has made and the job's settings;
what ``main`` does in the first process is done here once more.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import sys
import traceback
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import read_write

from occdetr.errors import InputError
from occdetr.training.ranks import OutsideRanks, name_local_tasks, outside_ranks

_started_by_user = False


class JobError(RuntimeError):
    """A defect that has ended a job in another process, with the traceback from there."""


def mark_users_process() -> None:
    """Called in the process that the user has started: jobs in it are none of a launcher's."""
    global _started_by_user
    _started_by_user = True


def elsewhere() -> bool:
    """Whether this is a process that a launcher has started."""
    return not _started_by_user


def begin(entry: str) -> OutsideRanks | None:
    """Make this process look as if ``python -m occdetr.<entry>`` had been started with the job's
    settings, for further processes that it starts; returns the ranks that share the job, if any.

    Further ranks get the first one's folder. Raises ``InputError`` if that has ended before.
    """
    settings: Any = HydraConfig.get()
    multiprocessing.set_start_method(None, force=True)  # joblib's is known to its processes alone
    sys.modules["__main__"].__spec__ = importlib.util.find_spec(f"occdetr.{entry}")
    sys.argv[1:] = list(settings.overrides.task)
    name_local_tasks()
    ranks = outside_ranks()
    if ranks is not None and ranks.rank > 0:
        with read_write(settings), read_write(settings.runtime):
            settings.runtime.output_dir = ranks.folder()
    return ranks


def survives_failure() -> bool:
    """Whether Hydra is to get the error of a job, instead of the program ending with it.

    Jobs of other processes leave it to the first one, and a sweeper that searches takes a failure
    as a result. Hydra's own would first run all the other jobs.
    """
    settings: Any = HydraConfig.get()
    target = settings.sweeper.get("_target_", "")
    searches = not target.endswith(f".{BasicSweeper.__name__}")
    return elsewhere() or (settings.mode == RunMode.MULTIRUN and searches)


def failure(error: Exception, line: str | None) -> Exception:
    """What Hydra gets for ``error``: text alone, which every process can read.

    It is also printed where the job runs, for its log.
    """
    text = "".join(traceback.format_exception(error)) if line is None else f"error: {line}"
    if elsewhere():
        print(text, file=sys.stderr, flush=True)
    return JobError(text) if line is None else InputError(line)
