"""Images of object labels."""

import cv2

from occdetr.data.frames import find_frames
from occdetr.data.objects import ObjectSettings
from occdetr.data.semantickitti import read_labels
from programs import program, read_json


def test_labels_are_drawn_and_described(streets, tmp_path):
    """The described voxels are those of the label files, and there is an image of each frame."""
    given = ("data=semantickitti", f"data.root={streets}", "data.train_sequences=[0,1]")
    places = (f"data.cache_dir={tmp_path / 'cache'}", f"hydra.run.dir={tmp_path / 'run'}")
    names = ["01/000000", "00/000000"]
    wanted = (f"frames={','.join(names)}", "width=400")
    assert program("visualize", "labels", *given, *places, *wanted) == 0
    frames = read_json(tmp_path / "run/labels.json")["frames"]
    assert [frame["frame"] for frame in frames] == names
    assert sum(len(frame["objects"]) for frame in frames) > 0
    for frame in frames:
        assert cv2.imread(str(tmp_path / "run" / frame["picture"])).shape[1] == 400
        (files,) = find_frames(streets, [frame["frame"][:2]])
        labels = read_labels(files)
        foreground = sum((labels == index).sum() for index in ObjectSettings().classes)
        assert 0 < sum(item["voxels"] for item in frame["objects"]) <= foreground
