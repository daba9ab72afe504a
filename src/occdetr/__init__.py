"""OccupancyDETR: one camera image -> 256 x 256 x 32 semantic voxels."""

import atexit
import importlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from occdetr.api import Camera, Model, Recording, Result, load

__version__ = "0.1.0"

#: What ``occdetr.api`` offers; imported when it is asked for, as it loads torch.
__all__ = ["Camera", "Model", "Recording", "Result", "load"]

#: Largest number of pixels of an image file, which bounds the memory that decoding it takes.
MAX_PIXELS = 2**27

#: The cores that this process may use, before OpenMP, which torch loads, binds its threads to one
#: core each (OMP_PROC_BIND); None where the system does not tell.
CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(importlib.import_module("occdetr.api"), name)
    raise AttributeError(f"module 'occdetr' has no attribute {name!r}")


def use_all_cores() -> None:
    """Let this thread, and what it starts, run on all ``CORES``, wherever OpenMP has bound it."""
    if CORES is not None:
        os.sched_setaffinity(0, CORES)


def _writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or in the nearest one that is there."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)


def _find_place_for_compiled_code() -> None:
    """Give numba a folder for this process if neither the package's nor the user's can be written:
    it refuses to compile else."""
    home = Path(os.path.expanduser("~"))
    places = (Path(__file__).parent, Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache"))
    if "NUMBA_CACHE_DIR" not in os.environ and not any(map(_writable, places)):
        folder = os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="occdetr-numba-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)


os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # read when OpenCV is loaded
_find_place_for_compiled_code()
