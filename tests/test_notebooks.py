"""Every notebook is kept without outputs, runs from its first cell to its last, shows pictures."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
#: Pictures of each notebook.
PICTURES = {"01_streets": 6, "02_how_it_works": 10, "03_your_photo": 3}

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_every_notebook_is_known_here():
    assert {path.stem for path in NOTEBOOKS} == PICTURES.keys()


@every_notebook
def test_a_notebook_is_kept_without_outputs(path):
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            assert (cell["execution_count"], cell["outputs"]) == (None, []), cell["source"]


@every_notebook
def test_a_notebook_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    folder = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=120, kernel_name="python3", resources=folder).execute()
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", ())]
    pictures = [out.data["image/png"] for out in outputs if "image/png" in out.get("data", ())]
    assert len(pictures) == PICTURES[path.stem]
    for encoded in pictures:
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), 1)
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50  # no empty canvas
