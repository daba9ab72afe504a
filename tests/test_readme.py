"""The Python of the README runs after the demo, here on other streets."""

from __future__ import annotations

import shutil

from omegaconf import OmegaConf

from documents import REPOSITORY, code_blocks, read


def test_the_python_of_the_readme_runs(streets, tmp_path, monkeypatch):
    code, photo = [code for language, code in code_blocks(read(REPOSITORY / "README.md"))
                   if language == "python"]  # fmt: skip
    demo = OmegaConf.load(REPOSITORY / "conf/data/synthetic_demo.yaml")
    shutil.copytree(streets / "sequences/08", tmp_path / demo.root / "sequences/08")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    result = names["result"]
    assert result.grid.shape == (256, 256, 32)
    assert 0 < result.grid.max() < 20
    assert len(result.scores) == len(result.boxes3d) == len(result.classes) > 0
    assert (tmp_path / "street.png").is_file()
    shutil.copy(tmp_path / demo.root / "sequences/08/image_2/000000.png", tmp_path / "photo.jpg")
    exec(compile(photo, "README.md", "exec"), names)
    assert (names["result"].grid == 255).any()
