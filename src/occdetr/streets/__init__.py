"""Synthetic streets: random worlds of exact solids, their images and their laser sweeps."""

import hashlib
from pathlib import Path


def _forget_stale_code() -> None:
    """Delete compiled functions if any file of this package has changed since they were cached.

    numba checks only the file of a function, not those of the functions that it calls.
    """
    folder = Path(__file__).parent
    sources = b"".join(path.read_bytes() for path in sorted(folder.glob("*.py")))
    now, note = hashlib.sha256(sources).hexdigest(), folder / "__pycache__" / "sources.sha256"
    try:
        if note.is_file() and note.read_text() == now:
            return
        for compiled in note.parent.glob("*.nb?"):
            compiled.unlink(missing_ok=True)
        note.parent.mkdir(exist_ok=True)
        note.write_text(now)
    except OSError:
        pass  # a folder that cannot be written: numba caches elsewhere


_forget_stale_code()
