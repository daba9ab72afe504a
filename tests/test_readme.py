"""The Python of the README runs, on a checkpoint of the smallest model after one step."""

from __future__ import annotations

import shutil

from documents import REPOSITORY, code_blocks, read


def test_the_python_of_the_readme_runs(varied_checkpoint, streets, tmp_path, monkeypatch):
    (code,) = [code for language, code in code_blocks(read(REPOSITORY / "README.md"))
               if language == "python"]  # fmt: skip
    target = tmp_path / "outputs/demo/full/last.ckpt"
    target.parent.mkdir(parents=True)
    shutil.copy(varied_checkpoint, target)
    sequence = streets / "sequences/08"
    shutil.copy(sequence / "image_2/000000.png", tmp_path / "street.png")
    shutil.copy(sequence / "calib.txt", tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    prediction = names["prediction"]
    assert prediction.grid.shape == (256, 256, 32)
    assert 0 < prediction.grid.max() < 20
    assert len(prediction.scores) == len(prediction.boxes3d) == len(prediction.classes) > 0
