"""The Python of docs/own-data.md writes frames that the data module reads."""

from __future__ import annotations

import numpy as np

from documents import REPOSITORY, code_blocks, read
from occdetr.classes import CLASS_NAMES
from occdetr.data.datamodule import SceneDataModule


def test_frames_of_ones_own_are_written_and_read(tmp_path, monkeypatch):
    (code,) = [
        c for kind, c in code_blocks(read(REPOSITORY / "docs/own-data.md")) if kind == "python"
    ]
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "own-data.md", "exec"), {})
    data = SceneDataModule(
        root=tmp_path / "data/mine", train_sequences=["00"], image_size=(96, 288)
    )
    (item,) = data.dataset("train")
    classes = [CLASS_NAMES[index] for index in item.target.classes.tolist()]
    assert classes == ["car"]
    (box,) = item.target.boxes3d_grid.numpy()
    np.testing.assert_allclose(box[:3], [14, 2, -0.95], atol=0.2)
    column, _, width, _ = item.target.boxes_cxcywh[0].tolist()
    assert column < 0.5  # it is on the left, as in the grid
    assert 0.05 < width < 0.3
    assert (item.labels == 9).sum() > 5000
