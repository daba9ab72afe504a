"""The statistics of synthetic streets."""

import cv2
import numpy as np

from occdetr.classes import CLASS_NAMES
from occdetr.data.frames import find_frames
from occdetr.data.semantickitti import read_labels
from occdetr.streets.settings import StreetSettings
from occdetr.streets.writer import GENERATOR_VERSION, write_streets
from programs import program, read_json


def test_survey_counts_the_labels_that_are_written(tmp_path, capsys):
    small = ("worlds=3", "split=train", "seed=5", "image_size=[64,208]", "sheet=2", "workers=1")
    assert program("survey", *small, f"hydra.run.dir={tmp_path}") == 0
    report = read_json(tmp_path / "survey.json")
    assert (report["generator_version"], report["worlds"]) == (GENERATOR_VERSION, 3)
    settings = StreetSettings(3, 0, seed=5, street_image_size=(64, 208))
    write_streets(tmp_path / "data", settings, progress=False)
    frames = find_frames(tmp_path / "data", ["00", "01", "02"], stride=5)
    counts = sum(np.bincount(read_labels(frame).ravel(), minlength=256) for frame in frames)
    counts = counts[1:20]
    shares = [report["classes"][name]["share"] for name in CLASS_NAMES[1:]]
    np.testing.assert_allclose(shares, 100 * counts / counts.sum())
    assert 90 < report["agreement"]["surfaces"] <= 100
    assert cv2.imread(str(tmp_path / "sheet.jpg")).shape[1] == 1500
    assert "occupied, of the grid" in capsys.readouterr().out
