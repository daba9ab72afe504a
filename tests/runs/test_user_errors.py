"""Users' errors: one line on stderr that names the setting or file, and exit code 2."""

import os
import sys

import cv2
import pytest

from occdetr.cli import entry as cli
from occdetr.errors import InputError
from programs import SHORT, program, the_error


@pytest.mark.parametrize(
    ("entry", "override", "expected"),
    [
        ("train", "model=huge", "model=huge: no such option: choose one of paper, "),
        ("train", "stage=fll", "choose one of full, pretrain"),
        ("train", "experiment=none_such", "no such option: choose one of convergence/early_"),
        ("train", "modle=tiny", "modle: no such setting: did you mean"),
        ("train", "trainer.max_epoch=3", "did you mean trainer.max_epochs"),
        ("train", "data.rot=x", "data.rot: no such setting: did you mean data.root"),
        ("train", "trainer.max_epochs=many", "trainer.max_epochs=many: give a whole number"),
        ("train", "trainer.accelerator=abacus", "choose one of auto, gpu"),
        ("train", "trainer.precision=3", "trainer.precision=3: choose one of "),
        ("train", "model", "'model' cannot be read"),
        ("train", "model=null", "a group takes the name of an option"),
        ("train", "callbacks=[1]", "takes names of options"),
        ("train", "image_size=[128]", "image_size=[128]: must be [height, width]"),
        ("train", "image_size=[32,32]", "fewer than the 100 queries"),
        ("train", "image_size=big", "image_size=big: must be [height, width]"),
        ("train", "data.batch_size=0", "data.batch_size=0: give 1 to "),
        ("train", "+data.objects.distance.cat=1", "unknown class 'cat'"),
        ("train", "+model.colour=red", "unexpected keyword argument 'colour'"),
        ("train", "resume=nowhere.ckpt", "nowhere.ckpt: no such file"),
        ("evaluate", "split=val", "checkpoint is not set: give it, as in checkpoint=outputs/"),
        ("evaluate", "checkpoint=nowhere.ckpt", "nowhere.ckpt: no such file"),
        ("evaluate", "model=tiny", "model=tiny: only for upper_bound=true without a checkpoint"),
        ("evaluate", "allow=5", "allow=5: give a list of names"),
        ("predict", "checkpoint=nowhere.ckpt", "images is not set"),
        ("benchmark", "device=abacus", "device=abacus: unknown device"),
        ("benchmark", "part=wheel", "part=wheel: choose one of model, scaling, loader"),
        ("benchmark", "precision=8-true", "choose one of auto, 32-true, bf16-mixed"),
        ("prepare", "shard=4/3", "shard=4/3: give i/n, the i-th of n jobs, as in shard=3/16"),
        ("prepare", "shard=0/3", "shard=0/3: give i/n"),
        ("prepare", "shard=third", "shard=third: give i/n"),
        ("prepare", "workers=-1", "workers=-1: give 0 to "),
        ("summarize", "curves=0", "curves=0: give 1 to 100"),
        ("summarize", "runs=nowhere", "runs=nowhere: no such folder"),
        ("survey", "worlds=0", "worlds=0: give 1 to 200000"),
        ("survey", "split=test", "split=test: choose one of train, val"),
        ("survey", "image_size=[8,200]", "image_size=[8, 200]: give 32 pixels or more"),
        ("visualize", "streets", "what=streets: no such pictures: use labels"),
        ("visualize", "split=test", "split=test: labels exist for train and val"),
        ("visualize", "width=9", "width=9: give 320 to "),
    ],
)
def test_wrong_setting(entry, override, expected, tmp_path, capsys):
    assert program(entry, override, f"hydra.run.dir={tmp_path}/run") == 2
    assert expected in the_error(capsys)


def linked_copy(streets, folder):
    """A dataset that can be changed: sequence 00 for training, 08 for validation."""
    for file in streets.glob("sequences/0[08]/**/*"):
        if file.is_file():
            goal = folder / file.relative_to(streets)
            goal.parent.mkdir(parents=True, exist_ok=True)
            os.link(file, goal)
    return folder


def replace(path, data):
    path.unlink()  # it is a link to the fixture's file
    path.write_bytes(data)


def truncate_label(root):
    path = root / "sequences/00/voxels/000000.label"
    replace(path, path.read_bytes()[:-1000])
    return "000000.label: file is truncated (4,194,304 bytes expected, 4,193,304 found)"


def drop_tr(root):
    path = root / "sequences/00/calib.txt"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("Tr")]
    replace(path, "\n".join(lines).encode())
    return "calib.txt: line 'Tr:' is missing: add it"


def shrink_picture(root):
    path = root / "sequences/00/image_2/000000.png"
    small = cv2.resize(cv2.imread(str(path)), (100, 60))
    replace(path, cv2.imencode(".png", small)[1].tobytes())
    return "000000.png: wrong image size: 100 x 60 pixels"


def drop_sequence(root):
    for path in sorted((root / "sequences/00").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    (root / "sequences/00").rmdir()
    return "sequence 00 is missing (found: 08)"


@pytest.mark.parametrize("damage", [truncate_label, drop_tr, shrink_picture, drop_sequence])
@pytest.mark.parametrize("workers", [0, 1])
def test_damaged_dataset(damage, workers, streets, tmp_path, capfd):
    root = linked_copy(streets, tmp_path / "data")
    expected = damage(root)
    data = ("data=semantickitti", f"data.root={root}", "data.train_sequences=[0]")
    given = (*SHORT, *data, f"data.num_workers={workers}", f"outputs={tmp_path}")
    assert program("train", "stage=pretrain", *given) == 2
    assert expected in the_error(capfd)


@pytest.mark.parametrize("entry", ["train", "prepare"])
def test_missing_dataset(entry, tmp_path, capsys):
    given = ("data=semantickitti", f"data.root={tmp_path}/nowhere", f"outputs={tmp_path}")
    assert program(entry, *given) == 2
    assert "nowhere: no dataset there" in the_error(capsys)


def test_truncated_checkpoint(checkpoint, tmp_path, capsys):
    broken = tmp_path / "broken.ckpt"
    broken.write_bytes(checkpoint.read_bytes()[:10_000])
    assert program("evaluate", f"checkpoint={broken}", f"hydra.run.dir={tmp_path}/run") == 2
    line = the_error(capsys)
    assert "broken.ckpt" in line
    assert "not a readable checkpoint" in line


def exit_code(error, folder, monkeypatch):
    """The exit code of an entry point that raises ``error``."""

    @cli.entry_point("predict")
    def main(config):
        raise error

    monkeypatch.setattr(sys, "argv", ["predict.py", f"hydra.run.dir={folder}"])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code


@pytest.mark.parametrize(
    ("entry", "override"),
    [
        *(("train", text) for text in ("~seed", "~monitor", "~model.encoder", "~trainer")),
        *(("evaluate", "~threads"), ("predict", "~seed"), ("survey", "~worlds")),
        *(("export", "~seed"), ("benchmark", "~part"), ("prepare", "~shard")),
        ("prepare", "~partition"),
    ],
)
def test_a_setting_that_a_command_needs_cannot_be_removed(entry, override, tmp_path, capsys):
    assert program(entry, override, f"hydra.run.dir={tmp_path / 'run'}") == 2
    assert f"error: {override}: " in the_error(capsys)


@pytest.mark.parametrize(("entry", "node"), [("train", "module"), ("benchmark", "scene")])
def test_nor_can_null_stand_for_it(entry, node, tmp_path, capsys):
    assert program(entry, f"{node}=null", f"hydra.run.dir={tmp_path / 'run'}") == 2
    assert f"error: {node}=null: " in the_error(capsys)


@pytest.mark.parametrize("swept", ["seed=0,1.5", "model=tiny,huge", "data.batch_size=1,many"])
def test_a_sweep_is_refused_before_its_first_job(swept, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr("occdetr.train.seed_everything", None)  # the first thing that a job does
    assert program("train", "-m", swept, f"outputs={tmp_path / 'out'}") == 2
    assert swept.split(",")[1] in the_error(capfd)


def test_defect_keeps_its_traceback(tmp_path, monkeypatch, capsys):
    assert exit_code(RuntimeError("a defect"), tmp_path, monkeypatch) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-1] == "RuntimeError: a defect"


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [(InputError("a reason"), 2, "error: a reason"), (KeyboardInterrupt(), 130, "interrupted")],
)
def test_exit_codes(error, code, line, tmp_path, monkeypatch, capsys):
    assert exit_code(error, tmp_path, monkeypatch) == code
    assert capsys.readouterr().err.strip() == line
