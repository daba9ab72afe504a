"""Hydra's plugins that run the jobs of a sweep: joblib, submitit and Optuna. All are optional."""

from __future__ import annotations

import importlib.util
import re
import shutil
import traceback
from pathlib import Path

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from omegaconf import DictConfig

from occdetr.errors import InputError

#: What a plugin's modules are for, by their first name.
_MODULES = {"submitit": "launcher", "joblib": "launcher", "optuna": "sweeper"}
_MOST = 300  # characters of a plugin's message


def prefer_own_options(config_dir: Path) -> None:
    """Let the options in ``conf/hydra`` replace those of the same name that plugins bring.

    Hydra would merge them, and refuse the settings that only one of both has.
    """
    Plugins.instance()  # registers theirs
    groups = ConfigStore.instance().repo.get("hydra", {})
    for file in (config_dir / "hydra").glob("*/*.yaml"):
        groups.get(file.parent.name, {}).pop(file.name, None)


def check_plugins(settings: DictConfig) -> None:
    """Raises ``InputError`` if what the node ``hydra`` names for a sweep is not there."""
    for kind in ("launcher", "sweeper"):
        target = str(settings[kind].get("_target_"))
        choice = f"hydra/{kind}={settings.runtime.choices[f'hydra/{kind}']}"
        package = ".".join(target.split(".")[:2])
        if package.startswith("hydra_plugins.") and not _is_installed(package):
            name = package.partition(".")[2].replace("_", "-")
            raise InputError(f"{choice}: {name} is not installed: pip install 'occdetr[sweeps]'")
        if target.endswith(".SlurmLauncher") and shutil.which("sbatch") is None:
            raise InputError(
                f"{choice}: there is no sbatch here: start it where jobs are submitted, or take "
                "hydra/launcher=submitit_local"
            )


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:  # of hydra_plugins itself
        return False


def explain_plugin(error: BaseException) -> str | None:
    """One line for what a plugin refuses, or for a job of which it got no result; else None."""
    frames = list(traceback.walk_tb(error.__traceback__))
    module = frames[-1][0].f_globals.get("__name__", "") if frames else ""
    kind = _MODULES.get(module.partition(".")[0])
    if kind is None:
        return None
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    lost = re.match(r"Job (\S+) .* with path (\S+)", lines[0]) if lines else None
    if lost is None:
        return f"hydra/{kind}: {' '.join(lines)[:_MOST]}"
    reasons = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return (
        f"job {lost[1]} ended without a result: {[lines[-1], *reasons][-1]}; its output is in "
        f"{Path(lost[2]).parent}"
    )
