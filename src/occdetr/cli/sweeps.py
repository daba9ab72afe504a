"""A sweep (``-m``), checked before its first job runs: later ones could be hours away."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from occdetr.cli import entry as cli
from occdetr.cli.plugins import check_plugins
from occdetr.errors import InputError

#: Settings of Hydra that only a sweep has.
_OF_SWEEPS = ("hydra/launcher=", "hydra/sweeper=")


class SweepCheck(Callback):
    """Hydra calls it; see ``conf/hydra/callbacks/sweep.yaml``.

    It ends the program with one line if a job has a wrong setting, or what is to run the jobs is
    not installed: Hydra would turn an exception into a warning.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        for text in config.hydra.overrides.hydra:
            if text.startswith(_OF_SWEEPS) and not text.endswith("=basic"):
                cli.stop("", InputError(f"{text}: is for a sweep: add -m, or leave it out"))

    def on_multirun_start(self, config: DictConfig, config_name: str, **kwargs: Any) -> None:
        try:
            _share_time(config)
            check_plugins(config.hydra)
            jobs = [cli.compose_checked(config_name, job) for job in _jobs(config)]
            for job in jobs:
                _check_devices(config.hydra, job)
            _check_order(config.hydra, jobs)
            # a search may store its trials there
            Path(config.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)
        except Exception as error:
            cli.stop(config_name, error)


def _share_time(config: DictConfig) -> None:
    """Read the clock for the names of the jobs' folders, once for all of them.

    The ranks of a job would else have different ones, and a job that is started again another.
    Hydra gives its jobs what the resolver of ``now`` has given here.
    """
    with contextlib.suppress(OmegaConfBaseException):  # the number of the job is not known yet
        str(config.hydra.sweep.subdir)


def _jobs(config: DictConfig) -> Iterator[list[str]]:
    """The settings of every job; of a sweeper that searches those that all jobs share."""
    sweeper = config.hydra.sweeper
    words = [f"{name}={value}" for name, value in (sweeper.params or {}).items()]
    words += list(config.hydra.overrides.task)
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    parsed = parser.parse_overrides(words)
    if str(sweeper._target_).endswith(f".{BasicSweeper.__name__}"):
        (jobs,) = BasicSweeper.split_arguments(parsed, None)
        yield from jobs
    else:
        yield [text.input_line or "" for text in parsed if not text.is_sweep_override()]


def _check_devices(settings: DictConfig, job: DictConfig) -> None:
    """A launcher that starts the ranks gives all jobs of a sweep the same machines."""
    for key, own in (("devices", "tasks_per_node"), ("num_nodes", "nodes")):
        wanted = OmegaConf.select(job, f"trainer.{key}")
        if own not in settings.launcher or wanted is None:
            continue
        setting, given = f"trainer.{key}={wanted}", settings.launcher[own]
        if type(wanted) is not int or wanted < 1:
            raise InputError(f"{setting}: give a number for hydra/launcher, which starts the ranks")
        if wanted != given:
            raise InputError(
                f"{setting}: hydra.launcher.{own} is {given} for all jobs: give both the same "
                "number, and start a sweep for each"
            )


def _check_order(settings: DictConfig, jobs: Sequence[DictConfig]) -> None:
    """A launcher starts all jobs at once: none can start from the checkpoint of another."""
    at_once = not str(settings.launcher._target_).endswith(f".{BasicLauncher.__name__}")
    starts = {job.get("stage_name"): job.get("init_from") for job in jobs}
    if at_once and "pretrain" in starts and starts.get("full") == "auto":
        choice = settings.runtime.choices["hydra/launcher"]
        raise InputError(
            f"stage=pretrain,full: hydra/launcher={choice} runs both at the same time, but "
            "stage=full starts from the other: sweep one after the other"
        )
