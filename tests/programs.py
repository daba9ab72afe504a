"""Running the entry points in tests, and the settings of the shortest useful runs."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

#: Height and width of the synthetic pictures.
IMAGE_SIZE = (124, 410)
#: Settings of a dataset of 2 + 3 small streets; ``data.root`` is missing.
STREETS = (
    *("data.num_train=2", "data.num_val=3", f"data.street_image_size={list(IMAGE_SIZE)}"),
    *("data.num_workers=0", "data.write_workers=1"),
)
#: Settings of a small network with few background voxels.
SMALL = (
    "model=tiny",
    "image_size=[64,208]",
    "model.occupancy_decoder.background.kept=[256,768,3072]",
)
#: The same with settings of a training of one step.
SHORT = (*SMALL, "trainer=cpu", "trainer.max_epochs=1")


def program(entry, *overrides):
    """Run an entry point in this process. Returns its exit code."""
    arguments, sys.argv = sys.argv, [f"{entry}.py", *map(str, overrides)]
    try:
        importlib.import_module(f"occdetr.{entry}").main()
    except SystemExit as end:
        return end.code
    finally:
        sys.argv = arguments
    return 0


def subprogram(entry, *overrides, **settings):
    """Run an entry point in a process of its own. Returns the completed process."""
    command = [sys.executable, "-m", f"occdetr.{entry}", *map(str, overrides)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **settings)


def alone(file):
    """Run a test's file as a program of its own, without the checks of shapes that the tests put
    around functions: the compiler cannot follow them."""
    path = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    environment = os.environ | {"PYTHONPATH": path}
    given = {"env": environment, "capture_output": True, "text": True, "check": False}
    done = subprocess.run([sys.executable, file], **given)
    assert done.returncode == 0, done.stderr[-3000:]


def newest(folder, pattern):
    """The file that was modified last of those that match a pattern."""
    return max(Path(folder).glob(pattern), key=lambda path: path.stat().st_mtime_ns)


def read_json(path):
    return json.loads(Path(path).read_text())


def the_error(capsys):
    """The single line on stderr."""
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    return lines[0]
