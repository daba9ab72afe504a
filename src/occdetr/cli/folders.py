"""The folder of a run: it holds one run alone, and nobody else's files are removed from it.

A run takes its folder by creating ``MARKER`` there, and locks that file for as long as it lasts.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import shutil
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import IO, Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, read_write

import occdetr
from occdetr.errors import InputError
from occdetr.files import remove_temporary_files
from occdetr.training.trainer import is_main_process

#: Hydra's folder of settings, written here instead, once the run's folder is known to be free.
RECORD = ".hydra"
MARKER = Path(RECORD, "occdetr.json")

#: Files that a run leaves, at any depth of its folder: only these are removed with it.
MADE = (
    *("config.yaml", "hydra.yaml", "overrides.yaml", "occdetr.json", "hparams.yaml"),
    *("metrics.json", "prepare.json", "check.json", "diagnosis.json", "upper_bound.json"),
    *("*.ckpt", ".*.tmp", "events.out.tfevents.*", "metrics.csv", "confusion.*"),
)
#: Those that a run may have written before it was refused.
_BEFORE_WORK = ("config.yaml",)


@contextlib.contextmanager
def own_folder(config: DictConfig, entry: str) -> Iterator[None]:
    """Take the folder of this Hydra job and write its settings to ``RECORD`` there.

    A folder with a default name that is taken gets a number behind its name. If the run is refused
    before it has made anything, the folder is free again. Further ranks use the first one's folder.

    Raises ``InputError`` if a folder that the user chose is not free.
    """
    if not is_main_process():
        yield
        return
    settings: Any = HydraConfig.get()
    sweep = settings.mode == RunMode.MULTIRUN
    setting = "hydra.sweep.subdir" if sweep else "hydra.run.dir"
    chosen = any(text.startswith(f"{setting}=") for text in settings.overrides.hydra)
    wanted = Path(settings.runtime.output_dir)
    with taken(wanted, entry, setting, numbered=not chosen) as folder:
        with read_write(settings), read_write(settings.runtime):
            settings.runtime.output_dir = str(folder)
            settings.run.dir = str(folder) if folder != wanted or sweep else settings.run.dir
        contents = {"config": config, "hydra": settings, "overrides": settings.overrides.task}
        for name, content in contents.items():
            OmegaConf.save(content, folder / RECORD / f"{name}.yaml")
        yield


@contextlib.contextmanager
def taken(
    folder: Path, entry: str, setting: str, numbered: bool = False, again: bool = False
) -> Iterator[Path]:
    """A folder that is this process's until the end; afterwards it holds a run of ``entry``.

    ``numbered``: ``folder_1``, ``folder_2`` and so on, if it is taken. ``again``: a former run of
    ``entry`` may be there, if it has ended. ``setting`` is what the user would change.

    Raises ``InputError`` if the folder holds another run or anything else.
    """
    if numbered:
        place, marker = _take_numbered(folder, entry)
    else:
        place, marker = folder, _take(folder, entry, setting, again)
    with marker:
        try:
            yield place
        except Exception:
            if not again:
                free(place, numbered)
            raise


class _Taken(InputError):
    """The folder has another owner."""


def _take_numbered(folder: Path, entry: str) -> tuple[Path, IO[str]]:
    """Take ``folder``, or the first free one of ``folder_1``, ``folder_2`` and so on."""
    place = folder
    for number in itertools.count(1):
        with contextlib.suppress(_Taken):
            return place, _take(place, entry, "", again=False)
        place = folder.with_name(f"{folder.name}_{number}")
    raise AssertionError  # numbers do not end


def _take(folder: Path, entry: str, setting: str, again: bool) -> IO[str]:
    another = f"set {setting} to another folder"
    remedy = f"{another}, or delete this one"
    folder.mkdir(parents=True, exist_ok=True)
    marker = folder / MARKER
    if not marker.exists() and any(path.name != RECORD for path in folder.iterdir()):
        raise _Taken(f"{folder}: is not empty, and its files are not of a run: {another}")
    marker.parent.mkdir(exist_ok=True)
    try:
        file = marker.open("x", encoding="utf-8")
        file.write(json.dumps({"entry": entry, "version": occdetr.__version__}) + "\n")
        file.flush()
    except FileExistsError:
        if not again or _entry_of(folder) != entry:
            raise _Taken(f"{folder}: holds a run already: {remedy}") from None
        file = marker.open("r+", encoding="utf-8")
    if not _lock(file):
        file.close()
        raise _Taken(f"{folder}: is in use by another run: wait for it, or {remedy}")
    return file


def _lock(file: IO[str]) -> bool:
    """Lock a file until it is closed; False if another process has."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        pass
    return True


def _entry_of(folder: Path) -> str | None:
    """The entry point whose run a folder holds; None if it holds none."""
    try:
        return json.loads((folder / MARKER).read_text(encoding="utf-8"))["entry"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that a run has left which was killed in its folder.

    Nothing is removed if the folder is none of a run, or its run is still going on.
    """
    if not (folder / MARKER).is_file():
        return
    with contextlib.suppress(OSError), (folder / MARKER).open("r+", encoding="utf-8") as marker:
        if _lock(marker):
            remove_temporary_files(folder)


def in_use(folder: Path) -> bool:
    """Whether a run is going on in a folder; False where the file system has no locks."""
    with contextlib.suppress(OSError), (folder / MARKER).open("r+", encoding="utf-8") as marker:
        return not _lock(marker)
    return False


def free(folder: Path, made: bool) -> None:
    """Leave a folder as it was before a run that has produced nothing; ``made``: remove it."""
    others = [path for path in folder.iterdir() if path.name not in (RECORD, *_BEFORE_WORK)]
    if others:
        return
    with contextlib.suppress(OSError):
        for path in (*folder.glob(f"{RECORD}/*"), *(folder / name for name in _BEFORE_WORK)):
            if any(fnmatch(path.name, pattern) for pattern in MADE):
                path.unlink(missing_ok=True)
        (folder / RECORD).rmdir()
        if made:
            folder.rmdir()


def remove_former_run(folder: Path, entry: str) -> None:
    """Remove the folder of a former run of ``entry``, if there is one.

    Raises ``InputError`` if the folder holds anything that such a run does not make, and if the
    run is still going on.
    """
    if not folder.exists() or not any(folder.iterdir()):
        return
    if _entry_of(folder) != entry or folder.is_symlink():
        raise InputError(f"{folder}: is not a run of {entry}: move it away or delete it")
    files = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    for file in files:
        if not any(fnmatch(file.name, pattern) for pattern in MADE):
            raise InputError(f"{file}: was not made by a run of {entry}: move it away or delete it")
    with (folder / MARKER).open("r+", encoding="utf-8") as marker:
        if not _lock(marker):
            raise InputError(f"{folder}: is in use by another run: wait for it to end")
        shutil.rmtree(folder)
