"""What the entry points share: composing the configuration, and ending with one clear line.

``python -m occdetr.<entry>`` ends with exit code 0, 2 (an error that the user can fix: one line on
stderr), 3 (prediction without some of the images, or a data set that lacks something), 75 (training
stopped by SIGTERM or SIGUSR1), 130 (interrupted) or 1 (a defect of this program, with its
traceback).
"""

from __future__ import annotations

import functools
import io
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from occdetr.cli import jobs
from occdetr.cli.allocator import keep_freed_memory
from occdetr.cli.denormals import flush_denormals
from occdetr.cli.folders import own_folder
from occdetr.cli.groups import check_choices
from occdetr.cli.overrides import literal_path, literal_paths
from occdetr.cli.plugins import prefer_own_options
from occdetr.cli.schema import check_types
from occdetr.cli.user_errors import explain
from occdetr.errors import InputError, NonFiniteError
from occdetr.training.ranks import OutsideRanks, outside_ranks
from occdetr.training.trainer import is_main_process, own_ranks

CHATTER = (
    ".*The dirpath has changed from.*",  # a resumed run has a folder of its own
    ".*your dataloader is not resumable.*",  # its sampler is
    ".*reference is not registered on the model yet.*",  # benchmark: losses without a Trainer
    ".*does not have many workers.*",
    ".*is not currently supported for `reduce_fx`.*",
    ".*It is recommended to use `self.log.*sync_dist=True.*",
    ".*number of training batches .* is smaller than the logging interval.*",
    ".*exists and is not empty.*",
    ".*in eval mode at the start of training.*",  # frozen batch norms
    ".*isinstance.treespec, LeafSpec.*",
    ".*When using devices > 1 .* distributed sampler.*",
    ".*Using `DistributedSampler` with the dataloaders.*",
)


def config_dir() -> Path:
    """The configuration: shipped inside a wheel, else the repository's own ``conf``."""
    package = Path(__file__).resolve().parents[1]
    shipped = package / "conf"
    return shipped if shipped.is_dir() else package.parents[1] / "conf"


def compose(config_name: str, overrides: Iterable[str] = ()) -> DictConfig:
    """The configuration that ``python -m occdetr.<config_name> <overrides>`` would run with."""
    given = list(map(literal_path, overrides))
    check_choices(given, config_dir())
    if GlobalHydra.instance().is_initialized():
        return hydra.compose(config_name, given)
    prefer_own_options(config_dir())
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
        return hydra.compose(config_name, given)


def compose_checked(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """``compose``, with errors in ``overrides`` reported as that program itself would.

    Raises ``InputError``.
    """
    own = functools.partial(compose, config_name)
    try:
        config = own(overrides)
        check_types(config)
    except Exception as error:
        line = explain(error, overrides, config_dir(), own)
        if line is None:
            raise
        raise InputError(line) from error
    return config


def entry_point(
    config_name: str, takes_folder: bool = True
) -> Callable[[Callable[[DictConfig], Any]], Callable[[], None]]:
    """Make ``task(config)`` a program whose settings come from ``conf/<config_name>.yaml``.

    What the task returns is the objective of Hydra's sweepers. ``takes_folder``: Hydra's run folder
    is for one run alone (``folders.own_folder``); else the task cares for its folders itself.
    """

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
        ranks: OutsideRanks | None = None

        @functools.wraps(task)
        def guarded(config: DictConfig) -> Any:
            # here, inside Hydra's job: outside, Hydra has already printed a line of its own
            try:
                shared = ranks
                if jobs.elsewhere():
                    _prepare_process()
                    shared = jobs.begin(config_name)
                taken = own_folder(config, config_name) if takes_folder else nullcontext()
                with taken, own_ranks():
                    check_types(config)
                    _run_as_one_job()
                    if shared is not None:
                        shared.give_folder(run_folder())
                    return task(config)
            except Exception as error:
                if jobs.survives_failure():
                    raise jobs.failure(error, _explained(config_name, error)) from None
                stop(config_name, error)

        @functools.wraps(task)
        def main() -> None:
            nonlocal ranks
            jobs.mark_users_process()
            _prepare_process()
            prefer_own_options(config_dir())
            program = hydra.main(
                version_base="1.3", config_path=str(config_dir()), config_name=config_name
            )
            try:
                sys.argv[1:] = literal_paths(sys.argv[1:])
                check_choices(sys.argv[1:], config_dir())
                ranks = outside_ranks()
                if ranks is not None:
                    ranks.take_folder()
                program(guarded)()
            except KeyboardInterrupt:
                print("interrupted", file=sys.stderr)
                sys.exit(130)
            except Exception as error:
                stop(config_name, error)

        return main

    return decorate


def _run_as_one_job() -> None:
    """In a sweep, Lightning starts the further ranks of this job alone.

    It does so with this process's command line and Hydra's ``run.dir``, which is this job's.
    """
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        settings: Any = HydraConfig.get()
        sys.argv[1:] = list(settings.overrides.task)


def _explained(config_name: str, error: Exception) -> str | None:
    """One line for an error that the user can fix; None for a defect."""
    running, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None
    try:
        return explain(error, sys.argv[1:], config_dir(), functools.partial(compose, config_name))
    finally:
        GlobalHydra.instance().hydra = running  # further jobs may follow


def stop(config_name: str, error: Exception) -> NoReturn:
    """End with one line and exit code 2 if the user can fix ``error``, else with a traceback.

    Raising it would let Hydra first run the other jobs of a sweep.
    """
    line = _explained(config_name, error)
    GlobalHydra.instance().clear()
    sys.stdout.flush()
    if line is None:
        traceback.print_exception(error)
        sys.exit(1)
    if is_main_process() or not isinstance(error, NonFiniteError):  # which all ranks raise
        print(f"error: {line}", file=sys.stderr)
    sys.exit(2)


def _prepare_process() -> None:
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # else Hydra prints and exits itself
    _silence_chatter()
    keep_freed_memory()
    flush_denormals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name may be in another alphabet
            stream.reconfigure(errors="backslashreplace")


def _silence_chatter() -> None:
    for name in ("lightning.pytorch", "lightning.fabric", "faster_coco_eval", "numba"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)  # their reports
    for message in CHATTER:
        warnings.filterwarnings("ignore", message)
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"


def run_folder() -> Path:
    """The folder of this run, made by Hydra."""
    return Path(HydraConfig.get().runtime.output_dir)


def shown(path: Path | str) -> str:
    """A path as the user would type it: relative if it is below the working directory."""
    path = Path(path).resolve()
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def required(config: DictConfig, key: str, example: str) -> Any:
    """The value of a setting that has no default. Raises ``InputError`` if it was not given."""
    value = OmegaConf.select(config, key, throw_on_missing=False)
    if value is None:
        raise InputError(f"{key} is not set: give it, as in {key}={example}")
    return value


def build(node: Any, **parts: Any) -> Any:
    """Construct what a node of the configuration describes, from plain lists and dictionaries.

    ``parts`` are further keywords of its constructor; with ``_partial_=True`` it is not called.
    """
    return hydra.utils.instantiate(node, _convert_="all", **parts)


def chosen_nodes(config: DictConfig, group: str) -> dict[str, DictConfig]:
    """The named nodes of a group such as ``callbacks``, without those that are null.

    Raises ``InputError`` for what is no node.
    """
    nodes = {key: node for key, node in (config.get(group) or {}).items() if node is not None}
    for key, node in nodes.items():
        if not isinstance(node, DictConfig) or "_target_" not in node:
            raise InputError(f"{group}.{key}={node}: give a node with _target_, or null")
    return {str(key): node for key, node in nodes.items()}


def plain(config: Any) -> Any:
    """Dictionaries, lists and scalars, every interpolation resolved."""
    return OmegaConf.to_container(config, resolve=True) if OmegaConf.is_config(config) else config
