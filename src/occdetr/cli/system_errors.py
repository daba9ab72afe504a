"""Errors of the machine that the user can fix, as one line each: disks, memory, processes."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool

import torch
from hydra.core.hydra_config import HydraConfig

_DISK = "free some space, or choose a folder on another disk"
_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), _DISK),
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), "check the path, or choose another"),
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP), "check the path"),
    errno.EEXIST: "a folder is needed there: choose another name",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EIO: "check the disk",
    errno.EMFILE: "raise the limit (ulimit -n), or lower data.num_workers",
}
#: An error of a data worker arrives as text.
_ERRNO = re.compile(r"\[Errno (\d+)\] [^:\n]*(?:: '([^'\n]*)')?")


def explain_system(error: BaseException) -> str | None:
    """One line for an error of the machine, also if it was the reason of ``error``; else None."""
    for cause in _chain(error):
        line = _explain(cause)
        if line is not None:
            return line
    return None


def _chain(error: BaseException) -> Iterator[BaseException]:
    current: BaseException | None = error
    while current is not None:
        yield current
        current = current.__cause__ or current.__context__


def _explain(error: BaseException) -> str | None:
    text = " ".join(str(error).split())
    if isinstance(error, torch.OutOfMemoryError):
        return "out of GPU memory: lower data.batch_size, or take a smaller model"
    if isinstance(error, MemoryError) or "can't allocate memory" in text:
        return "out of memory: lower data.batch_size or data.num_workers, or take a smaller model"
    if isinstance(error, BrokenProcessPool) or re.search(
        r"DataLoader worker .*(killed|exited)", text
    ):
        return (
            "a process that loads or writes data was killed by the system, mostly for want of "
            "memory: lower data.num_workers, data.write_workers or workers, or data.batch_size"
        )
    if "PytorchStreamWriter failed" in text or "unexpected pos" in text:  # torch.save
        place = _place(None)
        return f"{place}: a checkpoint could not be written, is it full?{_disk(place)}: {_DISK}"
    if isinstance(error, OSError):
        found = _ERRNO.search(text)
        number = error.errno or (int(found[1]) if found else None)
        name = error.filename or (found[2] if found else None)
        if number in _REMEDIES:
            place, reason = _place(name), os.strerror(number).lower()
            full = number in (errno.ENOSPC, errno.EDQUOT)
            return f"{place}: {reason}{_disk(place) if full else ''}: {_REMEDIES[number]}"
    return None


def _place(name: object) -> str:
    """The file of an error; where it is not known, the folder of the run."""
    if name is not None:
        return os.fsdecode(name) if isinstance(name, (str, bytes)) else str(name)
    if HydraConfig.initialized():
        return str(HydraConfig.get().runtime.output_dir)
    return os.getcwd()


def _disk(place: str) -> str:
    """Where the disk of a path is mounted."""
    path = os.path.abspath(place)
    while not os.path.ismount(path):
        path = os.path.dirname(path)
    return f" (disk {path})"
