"""Running the entry points in tests."""

import importlib
import subprocess
import sys
from pathlib import Path


def program(entry, *overrides):
    """Run an entry point here; its exit code."""
    arguments, sys.argv = sys.argv, [f"{entry}.py", *map(str, overrides)]
    try:
        importlib.import_module(f"occdetr.{entry}").main()
    except SystemExit as end:
        return end.code
    finally:
        sys.argv = arguments
    return 0


def subprogram(entry, *overrides, **settings):
    """The same in a process of its own."""
    command = [sys.executable, "-m", f"occdetr.{entry}", *map(str, overrides)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **settings)


def newest(folder, pattern):
    return max(Path(folder).glob(pattern), key=lambda path: path.stat().st_mtime_ns)


def the_error(capsys):
    """The one line on stderr."""
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    return lines[0]
