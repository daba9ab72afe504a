"""Synthetic streets: a random world of exact solids, its picture and its laser sweeps."""

import hashlib
from pathlib import Path


def _forget_stale_code() -> None:
    """Delete compiled functions if any file of this package has changed since they were cached.

    numba looks only at the file that a function stands in, not at those of the functions it calls.
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
        pass  # not ours to write: numba caches elsewhere


_forget_stale_code()
