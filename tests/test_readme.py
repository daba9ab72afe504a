"""The Python of the README runs after the demo, here on other streets."""

from __future__ import annotations

import shutil

from omegaconf import OmegaConf

from documents import REPOSITORY, code_blocks, read


def test_the_python_of_the_readme_runs(streets, tmp_path, monkeypatch):
    (code,) = [code for language, code in code_blocks(read(REPOSITORY / "README.md"))
               if language == "python"]  # fmt: skip
    demo = OmegaConf.load(REPOSITORY / "conf/data/synthetic_demo.yaml")
    shutil.copytree(streets / "sequences/08", tmp_path / demo.root / "sequences/08")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    prediction = names["prediction"]
    assert prediction.grid.shape == (256, 256, 32)
    assert 0 < prediction.grid.max() < 20
    assert len(prediction.scores) == len(prediction.boxes3d) == len(prediction.classes) > 0
