"""Every code cell of every notebook runs, and ends in a picture."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest
from PIL import Image

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path) -> None:
    cells = json.loads(path.read_text())["cells"]
    names: dict = {}
    for cell in cells:
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        shown = ast.Expression(tree.body.pop().value)
        exec(compile(tree, str(path), "exec"), names)
        picture = eval(compile(shown, str(path), "eval"), names)
        assert isinstance(picture, Image.Image)
        assert len(set(picture.resize((64, 64)).getdata())) > 50  # not an empty canvas
