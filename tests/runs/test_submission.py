"""The zip file for the hidden test: as the server wants it, and gone on with where it stopped."""

import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from occdetr.data.semantickitti import write_mask
from occdetr.errors import InputError
from occdetr.evaluation.submission import check_submission
from programs import program, the_error

SEQUENCES = [str(number) for number in range(11, 22)]


@pytest.fixture(scope="module")
def hidden(streets, tmp_path_factory) -> Path:
    """The streets as test sequences: images of every scan, voxels of every fifth, no labels."""
    root = tmp_path_factory.mktemp("hidden")
    source = streets / "sequences/08"
    occupied = np.zeros((256, 256, 32), bool)
    occupied[10, 10, 3] = True
    for number, sequence in enumerate(SEQUENCES):
        goal = root / "sequences" / sequence
        (goal / "image_2").mkdir(parents=True)
        shutil.copy(source / "calib.txt", goal)
        for scan in range(0, 7 if number == 0 else 2):
            image = source / f"image_2/{5 * (scan % 3):06d}.png"
            shutil.copy(image, goal / f"image_2/{scan:06d}.png")
        for scan in range(0, 7 if number == 0 else 2, 5):
            write_mask(goal / f"voxels/{scan:06d}.bin", occupied)
    last = root / "sequences/21"  # the real set has no voxels of some scans at the end
    shutil.copy(last / "image_2/000000.png", last / "image_2/000005.png")
    (last / "times.txt").write_text("0\n" * 6)
    (last / "voxels/._000000.bin").touch()  # of macOS
    return root


def servers_rules(file: Path, root: Path) -> list[str]:
    """What the server would complain about, written from its rules."""
    with zipfile.ZipFile(file) as archive:
        content = {name: archive.getinfo(name).file_size for name in archive.namelist()}
    problems = ["no sequences/"] if "sequences/" not in content else []
    needed = {"description.txt"}
    for sequence in SEQUENCES:
        problems += [
            f"no {folder}"
            for folder in (f"sequences/{sequence}/", f"sequences/{sequence}/predictions/")
            if folder not in content
        ]
        for scan in (root / "sequences" / sequence / "voxels").glob("[0-9]*"):
            name = f"sequences/{sequence}/predictions/{scan.stem}.label"
            voxels = scan.stat().st_size * 8
            if content.get(name, 0) != voxels * 2:
                problems.append(name)
            needed.add(name)
    files = {name for name in content if not name.endswith("/")}
    return problems + sorted(files - needed)


@pytest.fixture(scope="module")
def submission(varied_checkpoint, hidden, tmp_path_factory) -> tuple[Path, list[str]]:
    folder = tmp_path_factory.mktemp("submission")
    file = folder / "occdetr.zip"
    data = ("data=semantickitti", f"data.root={hidden}", "data.num_workers=0", "trainer=cpu")
    given = [f"checkpoint={varied_checkpoint}", f"submission={file}", *data]
    assert program("predict", *given, f"hydra.run.dir={folder}/run") == 0
    return file, given


def test_it_passes_the_servers_rules(submission, hidden) -> None:
    file, _ = submission
    assert servers_rules(file, hidden) == []
    assert check_submission(file, hidden) == 12
    with zipfile.ZipFile(file) as archive:
        raw = np.frombuffer(archive.read("sequences/11/predictions/000005.label"), "<u2")
        assert raw.any()
        assert b"method name: OccupancyDETR\n" in archive.read("description.txt")
        assert len(archive.namelist()) == 12 + 1 + 1 + 2 * 11


def test_the_same_command_goes_on(submission, tmp_path, capsys) -> None:
    file, given = submission
    before, folder = file.read_bytes(), file.with_suffix("")
    labels = sorted(folder.rglob("*.label"))
    labels[3].unlink()
    labels[4].write_bytes(b"half")
    times = {label: label.stat().st_mtime_ns for label in labels[:3] + labels[5:]}
    file.unlink()
    assert program("predict", *given, f"hydra.run.dir={tmp_path}/run") == 0
    assert "10 of 12 are in" in capsys.readouterr().out
    assert {label: label.stat().st_mtime_ns for label in times} == times
    assert file.read_bytes() == before


def test_predictions_of_other_weights_are_not_mixed_in(
    submission, checkpoint, tmp_path, capsys
) -> None:
    file, given = submission
    other = [f"checkpoint={checkpoint}", *given[1:], f"hydra.run.dir={tmp_path}/run"]
    assert program("predict", *other) == 2
    assert "has predictions of another checkpoint or data set" in the_error(capsys)
    state = file.with_suffix("") / "predictions.json"
    before = state.read_bytes()
    state.write_bytes(b"{")
    assert program("predict", *given, f"hydra.run.dir={tmp_path}/run3") == 2
    assert "has predictions of another checkpoint" in the_error(capsys)
    state.write_bytes(before)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").touch()
    own = [given[0], f"submission={tmp_path}/full.zip", *given[2:]]
    assert program("predict", *own, f"hydra.run.dir={tmp_path}/run2") == 2
    assert "full: is in use" in the_error(capsys)
    assert file.is_file()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["submission=a.tar"], "the name must end with .zip"),
        (["images=photos"], "and no images"),
        (["files=[npz]"], "files=[npz]: only for images"),
        (["data.stride=10"], "the server wants the 12 frames"),
        ([], "give data=semantickitti"),
    ],
)
def test_wrong_settings_are_named(change, message, submission, tmp_path, capsys) -> None:
    _, given = submission
    kept = [word for word in given if change or not word.startswith("data")]
    assert program("predict", *kept, *change, f"hydra.run.dir={tmp_path}/run") == 2
    assert message in the_error(capsys)


def test_settings_of_submissions_are_for_these_only(submission, tmp_path, capsys) -> None:
    _, given = submission
    photos = [given[0], "images=photos", "camera.fov=90", f"hydra.run.dir={tmp_path}/run"]
    assert program("predict", *photos, "trainer=cpu") == 2
    assert "trainer=cpu: only for a submission" in the_error(capsys)


def rewrite(source: Path, goal: Path, change) -> Path:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(goal, "w") as new:
        for name in old.namelist():
            for other, content in change(name, old.read(name)):
                new.writestr(other, content)
    return goal


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda n, c: [] if n == "sequences/" else [(n, c)], "sequences/ is missing"),
        (lambda n, c: [] if "15/predictions/000000" in n else [(n, c)], "000000.label is missing"),
        (lambda n, c: [(n, c[:-2])] if "15/p" in n and c else [(n, c)], "in place of 4194304"),
        (lambda n, c: [(n, c), *([("x.txt", c)] if "desc" in n else [])], "x.txt does not belong"),
    ],
)
def test_a_wrong_zip_is_refused(change, message, submission, hidden, tmp_path) -> None:
    wrong = rewrite(submission[0], tmp_path / "wrong.zip", change)
    with pytest.raises(InputError, match=message):
        check_submission(wrong, hidden)
    (tmp_path / "broken.zip").write_bytes(submission[0].read_bytes()[:-100])
    with pytest.raises(InputError, match="is no whole zip file"):
        check_submission(tmp_path / "broken.zip", hidden)
