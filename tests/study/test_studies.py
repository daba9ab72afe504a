"""Studies: planned, run, interrupted, and drawn from their files."""

from __future__ import annotations

import json
import shlex
import subprocess
from pathlib import Path

import cv2
import pytest

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.cli.subprocesses import Command
from occdetr.files import write_json
from occdetr.streets.moment import Camera
from occdetr.streets.writer import GENERATOR_VERSION, write_streets
from occdetr.study import arm as arms
from occdetr.study import plan as study
from occdetr.study.curves import draw_curves
from occdetr.study.provenance import code_hash, code_state, file_hash
from occdetr.study.tables import mean_curve
from programs import program, subprogram, the_error

PICTURE_SIZE = (124, 410)
TINY = (
    *("image_size=[64,208]", "data.num_train=2", "data.num_val=2", "data.num_workers=0"),
    *(f"data.street_image_size={list(PICTURE_SIZE)}", "data.write_workers=1"),
    *("trainer=cpu", "trainer.check_val_every_n_epoch=1"),
)


@pytest.fixture(scope="module")
def streets(tmp_path_factory):
    """A dataset of 2 + 2 streets; to be read only."""
    root = tmp_path_factory.mktemp("streets")
    write_streets(root, 2, 2, camera=Camera(PICTURE_SIZE), progress=False)
    return root


def run_here(entry, overrides, folder):
    """``run_entry`` without a process of its own."""
    assert program(entry, *overrides, f"hydra.run.dir={folder}") == 0
    return Command(shlex.join(["python", "-m", f"occdetr.{entry}", *overrides]), 1.0)


def plan(name, *settings):
    config = cli.compose("study", [f"name={name}", *settings])
    return study.planned_runs(config, study.read_study(name))


def tiny_runs(name, arm, root, *settings):
    texts = ",".join(f"'{text}'" for text in (*TINY, f"data.root={root}"))
    return plan(name, f"arms=[{arm}]", "seeds=[3]", f"overrides=[{texts}]", *settings)


# ------------------------------------------------------------------------------------- plan


def test_a_study_is_planned_seed_by_seed():
    runs = plan("convergence", "arms=[mixed,two_stage]", "seeds=[4,0]", "overrides=['a=1']")
    assert [run.name for run in runs] == [
        *("mixed_seed4", "two_stage_seed4", "mixed_seed0", "two_stage_seed0")
    ]
    assert runs[0].overrides == ("experiment=convergence/mixed", "seed=4", "a=1")
    assert len(plan("convergence")) == len(plan("partition")) == 6


@pytest.fixture(scope="module")
def detection():
    """The configuration of each arm of the convergence study."""
    return {run.arm: run.settings() for run in plan("convergence", "seeds=[0]")}


@pytest.fixture(scope="module")
def partition():
    """The same of each stage of each arm of the partition study."""
    return {
        (run.arm, stage): cli.compose("train", [f"stage={stage}", *run.overrides])
        for run in plan("partition", "seeds=[0]")
        for stage in run.stages
    }


def test_arms_of_a_study_have_the_same_budget(detection, partition):
    """As many frames, and a validation after the last step."""
    budgets = {}
    for (arm, _), config in partition.items():
        assert config.trainer.max_epochs % config.trainer.check_val_every_n_epoch == 0
        frames = config.trainer.max_epochs * config.data.num_train
        budgets[arm] = budgets.get(arm, 0) + frames
    assert set(budgets.values()) == {3840}
    for config in detection.values():
        assert config.trainer.max_epochs * config.data.num_train // config.data.batch_size == 4320
        assert config.trainer.max_epochs == 12 * config.trainer.check_val_every_n_epoch


def test_arms_differ_in_what_they_are_named_after(detection, partition):
    assert all(config.partition_name == arm for (arm, _), config in partition.items())
    shares = {arm: config.early_matching_share for arm, config in detection.items()}
    assert shares == {"early_matching": 0.5, "two_stage": 0.0, "mixed": 0.0}
    contents = {arm: config.query_content for arm, config in detection.items()}
    assert contents == {"early_matching": "token", "two_stage": "token", "mixed": "learned"}


def test_every_split_leaves_out_one_sequence():
    runs = plan("real", "arms=[real,position]")
    assert len(runs) == 20
    every = {"00", "01", "02", "03", "04", "05", "06", "07", "09", "10"}
    left_out = set()
    for run in runs[::2]:
        given = dict(text.split("=") for text in run.overrides)
        (held_out,) = json.loads(given["data.val_sequences"])
        assert {*json.loads(given["data.train_sequences"]), held_out} == every
        assert len(json.loads(given["data.train_sequences"])) == 9
        left_out.add(held_out)
    assert left_out == every
    data = runs[0].settings().data
    assert ("00" in data.train_sequences, list(data.val_sequences)) == (False, ["00"])


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ((), "name is not set: give it, as in name=convergence"),
        (("name=shapes",), "no such study: choose one of convergence, partition, real"),
        (("name=partition", "arms=[two_stage]"), "has no two_stage: choose of mixed, all_fore"),
        (("name=partition", "arms=mixed"), "arms=mixed: must be a list such as [mixed]"),
        (("name=partition", "seeds=[-1]"), "a seed is a whole number from 0 on"),
        (("name=real", "seeds=[10]"), "name=real has no 10: choose of 0, 1"),
        (("name=real",), "start is not set: give it"),
        (("name=real", "start=none.ckpt"), "none.ckpt: no such file"),
        (("name=partition", "overrides=['trainer.max_epoch=1']"), "did you mean trainer.max_ep"),
        (("name=partition", "overrides=['data.flip=often']"), "data.flip: Value 'often' of type"),
        (("name=partition", "overrides=['model=huge']"), "model=huge: no such option"),
    ],
)
def test_a_mistake_is_told_in_one_line_before_anything_runs(settings, expected, tmp_path, capsys):
    places = (f"folder={tmp_path}/runs", f"results={tmp_path}/results")
    assert program("study.plan", *settings, *places) == 2
    assert expected in the_error(capsys)
    assert not (tmp_path / "results").exists()


def test_the_options_of_a_group_include_those_of_its_folders(tmp_path, capsys):
    assert program("train", "experiment=partition/none", f"hydra.run.dir={tmp_path}") == 2
    line = the_error(capsys)
    assert "experiment=partition/none: no such option: choose one of convergence/early" in line
    assert "partition/all_background, partition/all_foreground, partition/mixed" in line
    assert "common" not in line


# -------------------------------------------------------------------------------------- runs


def test_a_detection_arm_is_trained_and_recorded(streets, tmp_path, monkeypatch):
    monkeypatch.setattr(arms, "run_entry", run_here)
    (run,) = tiny_runs("convergence", "early_matching", streets)
    (run,) = [arms.StudyRun(**{**vars(run), "overrides": (*run.overrides, "trainer.max_epochs=3")})]
    record = arms.perform(run, tmp_path, None)
    assert [point["step"] for point in record["curve"]] == [1, 2, 3]
    assert set(record["curve"][0]) == {"stage", "step", "mAP", "AP50", "recall3d_25"}
    assert set(record["figures"]) == {"mAP", "AP50", "recall3d_25"}
    facts = record["stages"]["pretrain"]
    assert (record["steps"], facts["steps"], facts["batch_size"], facts["lr"]) == (3, 3, 2, 1e-3)
    assert 200 < record["peak_memory_mb"] == facts["peak_memory_mb"]
    assert 0 < record["seconds"] == facts["seconds"]
    assert record["generator_version"] == GENERATOR_VERSION
    assert "2 frames" in record["data"]["train"]
    assert record["machine"]["cores"] >= 1
    assert len(record["code"]) == 12
    train, evaluate = record["commands"]
    assert "occdetr.train stage=pretrain experiment=convergence/early_matching seed=3" in train
    assert evaluate == f"python -m occdetr.evaluate checkpoint={tmp_path}/pretrain/last.ckpt"


def test_the_real_study_begins_from_a_checkpoint(streets, tmp_path, monkeypatch):
    """Fine-tuning starts from a full checkpoint; the arm beside it evaluates it as it is."""
    monkeypatch.setattr(arms, "run_entry", run_here)
    start = ["stage=full", "init_from=scratch", "model=tiny", "data=synthetic"]
    short = ["trainer.max_epochs=1", f"hydra.run.dir={tmp_path}/start", f"data.root={streets}"]
    assert program("train", *start, *TINY, *short) == 0
    checkpoint = tmp_path / "start" / "last.ckpt"
    settings = ("image_size=[64,208]", "data.num_workers=0", "trainer=cpu", "trainer.max_epochs=1")
    sequences = ('data.train_sequences=["00"]', 'data.val_sequences=["01"]')
    own = (f"data.root={streets}", *sequences, *settings)
    records = {}
    for arm, stages in (("finetuned", ("full",)), ("synthetic", ()), ("position", ())):
        run = arms.StudyRun(
            *("real", arm, 0, (f"experiment=real/{arm}", *own), stages),
            start=None if arm == "position" else checkpoint,
            baseline=arm == "position",
        )
        records[arm] = arms.perform(run, tmp_path / arm, None)
    finetuned, synthetic, position = records.values()
    assert finetuned["start"]["sha256"] == synthetic["start"]["sha256"] == file_hash(checkpoint)
    assert position["start"] is None
    assert f"init_from={checkpoint}" in finetuned["commands"][0]
    assert [record["steps"] for record in records.values()] == [1, 0, 0]
    assert finetuned["figures"] != synthetic["figures"]
    assert position["figures"]["mIoU"] > 0
    for record in records.values():
        assert set(record["figures"]["per_class"]) == set(CLASS_NAMES[1:])
        assert (record["generator_version"], "1 frame" in record["data"]["val"]) == (None, True)
    assert "data=semantickitti" in synthetic["commands"][0]


def fake_record(run, *_):
    return {"figures": {}, "curve": [], "machine": {}, "who": run.name}


def test_a_study_goes_on_where_it_was_interrupted(tmp_path, monkeypatch, capsys):
    done = []

    def perform(run, *_):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(run.name)
        return fake_record(run)

    monkeypatch.setattr(study, "perform", perform)
    places = (f"folder={tmp_path}/runs", f"results={tmp_path}/results")
    given = ("name=convergence", "seeds=[0]", *places)
    assert program("study.plan", *given) == 130
    files = sorted(path.name for path in (tmp_path / "results").rglob("*") if path.is_file())
    assert files == ["early_matching_seed0.json", "two_stage_seed0.json"]
    monkeypatch.setattr(study, "perform", fake_record)
    assert program("study.plan", *given) == 0
    assert "1 of 3: " in capsys.readouterr().out
    found = json.loads((tmp_path / "results/convergence/mixed_seed0.json").read_text())
    assert found["who"] == "mixed_seed0"
    assert found["command"].endswith("'arms=[mixed]' 'seeds=[0]' rebuild=true")
    kept = tmp_path / "results/convergence/two_stage_seed0.json"
    before = kept.stat().st_mtime_ns
    assert program("study.plan", *given) == 0
    assert kept.stat().st_mtime_ns == before
    assert program("study.plan", *given, "rebuild=true", "arms=[two_stage]") == 0
    assert kept.stat().st_mtime_ns > before


def test_a_failing_training_ends_the_study_without_a_result(streets, tmp_path, capfd):
    """The training says why."""
    few = (*TINY, f"data.root={streets}", "trainer.max_epochs=1", "trainer.accelerator=abacus")
    overrides = ",".join(f"'{text}'" for text in few)
    places = (f"folder={tmp_path}/runs", f"results={tmp_path}/results")
    only = ("name=convergence", "arms=[mixed]", "seeds=[0]", f"overrides=[{overrides}]")
    assert program("study.plan", *only, *places) == 2
    assert "error: trainer: " in the_error(capfd)
    assert not list((tmp_path / "results").rglob("*"))


@pytest.mark.slow
def test_a_whole_study(streets, tmp_path):
    """Two arms of the partition study, in processes of their own, then again, then drawn."""
    few = (*TINY, f"data.root={streets}", "epochs={pretrain: 1, full: 2}")
    overrides = ",".join(f"'{text}'" for text in few)
    places = (f"folder={tmp_path}/runs", f"results={tmp_path}/results")
    only = ("name=partition", "arms=[mixed,all_background]", "seeds=[0]")
    given = (*only, *places, f"overrides=[{overrides}]")
    done = subprogram("study", *given)
    assert done.returncode == 0, done.stderr
    paths = [
        tmp_path / f"results/partition/{arm}_seed0.json" for arm in ("mixed", "all_background")
    ]
    mixed, background = (json.loads(path.read_text()) for path in paths)
    steps = [(stage, facts["steps"]) for stage, facts in mixed["stages"].items()]
    assert steps == [("pretrain", 1), ("full", 2)]
    assert [(point["stage"], point["step"]) for point in mixed["curve"]] == [
        *(("pretrain", 1), ("full", 2), ("full", 3))
    ]
    assert "mIoU" in mixed["curve"][-1]
    assert list(background["stages"]) == ["full"]
    assert "AP50" not in background["figures"]
    assert background["latency"]["latency_ms"] > 0
    assert background["peak_memory_mb"] > 200
    again = subprogram("study", *given)
    assert again.returncode == 0
    assert again.stdout.count("is there already") == 2
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    drawn = subprogram("study.results", *places[1:], f"page={page}", f"images={tmp_path}/images")
    assert drawn.returncode == 0, drawn.stderr
    assert "| `all_foreground` | - | - | - |" in page.read_text()


# ------------------------------------------------------------------------------------ results

EMPTY_PAGE = """# Results

Text before.

<!-- convergence -->
<!-- end -->

Between.

<!-- partition -->
old lines
<!-- end -->
<!-- real -->
<!-- end -->
After.
"""


def write_record(folder, name, arm, seed, **facts):
    machine = {"cpu": "a CPU", "cores": 2, "device": "cpu", "torch": "2.13.0", "precision": "32"}
    record = {
        **{"study": name, "arm": arm, "seed": seed, "commit": "a" * 40, "dirty": False},
        "command": f"python -m occdetr.study name={name} 'arms=[{arm}]' 'seeds=[{seed}]'",
        **{"code": "0123456789ab", "code_changed": False},
        **{"generator_version": 2, "machine": machine, "model": "tiny", "seconds": 600.0},
        **{"steps": 40, "peak_memory_mb": 1000.0, "curve": [], "stages": {}, **facts},
    }
    write_json(folder / name / f"{arm}_seed{seed}.json", record)


SMALL = ["bicycle", "motorcycle", "person", "bicyclist", "motorcyclist", "pole", "traffic-sign"]


def per_class(small, others):
    return {name: small if name in SMALL else others for name in CLASS_NAMES[1:]}


@pytest.fixture
def records(tmp_path):
    """Hand-made results: convergence with two seeds, partition and real with runs missing."""
    curves = {"early_matching": (0.3, 0.5), "two_stage": (0.1, 0.3), "mixed": (0.2, 0.6)}
    for arm, (half, whole) in curves.items():
        for seed, more in ((0, 0.0), (1, 0.02)):
            points = [(20, half + more), (40, whole + more)]
            curve = [{"stage": "pretrain", "step": s, "AP50": v, "mAP": v / 2} for s, v in points]
            figures = {"AP50": whole + more, "mAP": whole / 2, "recall3d_25": 0.25}
            write_record(tmp_path, "convergence", arm, seed, figures=figures, curve=curve)
    for arm, small, others in (("mixed", 0.06, 0.2), ("all_background", 0.015, 0.16)):
        classes = per_class(small, others)
        figures = {"mIoU": sum(classes.values()) / 19, "IoU": 0.4, "per_class": classes}
        facts = {"latency": {"latency_ms": 400.4}, "dirty": True}
        curve = [{"stage": "full", "step": s, "mIoU": 0.1, "IoU": 0.3} for s in (20, 40)]
        write_record(tmp_path, "partition", arm, 0, figures=figures, curve=curve, **facts)
    for split in range(3):
        figures = {"mIoU_present": 0.1 * split, "IoU": 0.5, "per_class": per_class(0, 0)}
        write_record(tmp_path, "real", "position", split, figures=figures, steps=0, seconds=0.0)
    for split, miou in ((1, 0.3), (2, 0.1)):
        figures = {"mIoU_present": miou, "IoU": 0.6, "per_class": per_class(0, 0)}
        write_record(tmp_path, "real", "finetuned", split, figures=figures)
    return tmp_path


def draw(records, page):
    places = (f"results={records}", f"page={page}", f"images={records}/images")
    return program("study.results", *places, f"hydra.run.dir={records}")


def block(text, name):
    return text.split(f"<!-- {name} -->\n")[1].split("<!-- end -->")[0].strip().splitlines()


def test_results_are_drawn_from_their_files(records, tmp_path, capsys):
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    assert draw(records, page) == 0
    text = page.read_text()
    assert block(text, "convergence") == CONVERGENCE.strip().splitlines()
    assert block(text, "partition")[:9] == PARTITION.strip().splitlines()
    assert "| bicycle | 6.0 | - | 1.5 |" in text
    assert "- mIoU: `mixed` has 1.39 times that of `all_background`." in text
    assert "- small classes: `mixed` has 4.00 times that of `all_background`." in text
    assert "| `position` | 3 | 10.0 ± 10.0 | 50.0 ± 0.0 | 0 ± 0 |" in text
    assert "| 2 | - | - | 10.0 | 20.0 |" in block(text, "real")
    gain = "- mIoU: `finetuned` less `position` is 5.0 ± 21.2; it is ahead in 1 of 2 splits."
    assert block(text, "real")[-2:] == ["", gain]
    assert "partition: 2 results; missing: mixed seed 1; all_foreground" in capsys.readouterr().out
    assert "<!-- end -->\n\nBetween.\n\n<!-- partition -->\n`python" in text
    assert text.startswith("# Results\n\nText before.\n\n<!-- convergence -->\n")
    assert text.endswith("<!-- end -->\nAfter.\n")


def test_a_study_with_other_settings_has_a_block_where_the_page_wants_one(records, tmp_path):
    overrides = "\"overrides=['data.num_train=9','model=small']\""
    command = f"python -m occdetr.study name=convergence results=larger {overrides}"
    for seed in (0, 1):
        figures, curve = {"AP50": 0.6, "mAP": 0.4, "recall3d_25": 0.3}, [{"step": 20, "AP50": 0.6}]
        chosen = f"{command} 'arms=[mixed]' 'seeds=[{seed}]' rebuild=true"
        facts = {"figures": figures, "curve": curve, "command": chosen}
        write_record(tmp_path / "larger", "convergence", "mixed", seed, **facts)
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE + "\n<!-- larger/convergence -->\nold\n<!-- end -->\n")
    assert draw(records, page) == 0
    lines = block(page.read_text(), "larger/convergence")
    first = " ".join(lines[: lines.index("")])  # wrapped; a space after each comma of a list
    assert first.startswith(f"`{command}`; 2 runs; ".replace("','", "', '"))
    assert max(map(len, lines)) <= 120
    assert "Missing: early_matching seed 0, 1; two_stage seed 0, 1." in lines
    assert "| `mixed` | 60.0 ± 0.0 | 40.0 ± 0.0 | 30.0 ± 0.0 | 40 | 10 ± 0 |" in lines
    assert lines[-1] == "![convergence on the way](images/larger-convergence.png)"
    assert (records / "images" / "larger-convergence.png").exists()
    assert block(page.read_text(), "convergence") == CONVERGENCE.strip().splitlines()


@pytest.mark.parametrize(("found", "shown"), [(0.0, "0"), (0.00002, "0.002")])
def test_an_arm_that_finds_next_to_nothing_is_said(found, shown, records, tmp_path):
    path = records / "partition" / "all_background_seed0.json"
    record = json.loads(path.read_text())
    record["figures"]["per_class"] |= dict.fromkeys(SMALL, found)
    write_json(path, record)
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    assert draw(records, page) == 0
    assert f"- small classes: `mixed` has 6.00 %, `all_background` {shown}." in page.read_text()


def test_curves_over_frames_count_each_stages_batches():
    stages = {"pretrain": {"steps": 30, "batch_size": 2}, "full": {"steps": 20, "batch_size": 1}}
    points = [{"step": 15, "AP50": 0.1}, {"step": 30, "AP50": 0.2}, {"step": 50, "AP50": 0.3}]
    records = {0: {"stages": stages, "curve": points}}
    assert mean_curve(records, "AP50") == {15: [0.1], 30: [0.2], 50: [0.3]}
    assert mean_curve(records, "AP50", frames=True) == {30: [0.1], 60: [0.2], 80: [0.3]}


def test_arms_with_other_batches_are_drawn_over_frames():
    def drawn(*batches):
        curve = [{"step": step, "mIoU": 0.1} for step in (20, 40)]
        stages = [{"full": {"steps": 40, "batch_size": batch}} for batch in batches]
        arms = [{0: {"curve": curve, "stages": own}} for own in stages]
        return draw_curves({"one": arms[0], "other": arms[1]}, ["mIoU"], "title")

    assert drawn(1, 1) == drawn(2, 2)  # steps tell as much
    assert drawn(2, 1) != drawn(2, 2)


def test_drawing_again_changes_nothing(records, tmp_path):
    page, files = tmp_path / "results.md", []
    page.write_text(EMPTY_PAGE)
    for _ in range(2):
        assert draw(records, page) == 0
        pictures = sorted((records / "images").glob("*"))
        files.append([page.read_bytes(), *(path.read_bytes() for path in pictures)])
    assert files[0] == files[1]
    assert [path.name for path in pictures] == ["convergence.png", "partition.png"]
    picture = cv2.imread(str(pictures[0]))
    assert picture.shape[1] > 800
    assert (picture != 255).any(-1).mean() > 0.02


def test_without_results_the_page_says_so(tmp_path):
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    assert draw(tmp_path / "none", page) == 0
    expected = ["No results yet: `python -m occdetr.study name=real`."]
    assert block(page.read_text(), "real") == expected


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("convergence/broken_seed0.json", "{}", "of no arm of convergence (early_matching, two"),
        ("convergence/mixed.json", "{}", "name it <arm>_seed<k>.json, or move it elsewhere"),
        ("convergence/mixed_seed0.json", "{", "mixed_seed0.json: no result of occdetr.study"),
        ("real/real_seed0.json", "[1]", "real_seed0.json: no result of occdetr.study"),
        ("results.md", EMPTY_PAGE.replace("real", "reel"), "a line <!-- real --> and one"),
        ("results.md", EMPTY_PAGE.replace("<!-- end -->\n<", "<"), "a line <!-- partition -->"),
    ],
)
def test_a_spoilt_file_is_named(name, content, expected, records, tmp_path, capsys):
    (tmp_path / "results.md").write_text(EMPTY_PAGE)
    (tmp_path / name).write_text(content)
    assert draw(records, tmp_path / "results.md") == 2
    assert expected in the_error(capsys)


def test_a_missing_page_is_named(records, tmp_path, capsys):
    assert draw(records, tmp_path / "nowhere.md") == 2
    assert "nowhere.md" in the_error(capsys)


def test_the_page_of_this_repository_has_its_markers():
    text = (Path(__file__).parents[2] / "docs" / "results.md").read_text()
    for name in ("convergence", "partition", "real"):
        assert len(block(text, name)) >= 1


def test_the_state_of_the_code_is_recorded(tmp_path):
    assert code_state(tmp_path) == {"commit": None, "dirty": None}
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    (tmp_path / "src").mkdir()
    (tmp_path / "src/a.py").write_text("1")
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        subprocess.run([*git, *command], check=True)
    clean = code_state(tmp_path)
    assert (len(clean["commit"]), clean["dirty"]) == (40, False)
    (tmp_path / "notes.txt").write_text("not code")
    assert code_state(tmp_path) == clean
    before = code_hash(tmp_path)
    (tmp_path / "src/b.py").write_text("2")
    assert code_state(tmp_path) == {**clean, "dirty": True}
    (tmp_path / "src/c.txt").write_text("not code")
    between = code_hash(tmp_path)
    assert len({before, between}) == 2
    (tmp_path / "src/b.py").rename(tmp_path / "src/d.py")
    assert code_hash(tmp_path) not in (before, between)


CONVERGENCE = """
`python -m occdetr.study name=convergence`; 6 runs; commit aaaaaaa; generator version 2; `model=tiny`; a CPU, 2 cores,
cpu, torch 2.13.0, 32.

| arm | AP50 | mAP | 3D recall | steps | minutes of training |
| --- | --- | --- | --- | --- | --- |
| `early_matching` | 51.0 ± 1.4 | 25.0 ± 0.0 | 25.0 ± 0.0 | 40 | 10 ± 0 |
| `two_stage` | 31.0 ± 1.4 | 15.0 ± 0.0 | 25.0 ± 0.0 | 40 | 10 ± 0 |
| `mixed` | 61.0 ± 1.4 | 30.0 ± 0.0 | 25.0 ± 0.0 | 40 | 10 ± 0 |

AP50 at the validations on the way:

| step | `early_matching` | `two_stage` | `mixed` |
| --- | --- | --- | --- |
| 20 | 31.0 ± 1.4 | 11.0 ± 1.4 | 21.0 ± 1.4 |
| 40 | 51.0 ± 1.4 | 31.0 ± 1.4 | 61.0 ± 1.4 |

- Early matching reaches `two_stage`'s last AP50 (31.0) after 20 of its 40 steps (50 %).
- Early matching is above `mixed` selection at 1 of 2 validations.

![convergence on the way](images/convergence.png)
"""  # noqa: E501

PARTITION = """
`python -m occdetr.study name=partition`; 2 runs; commit aaaaaaa, code 0123456789ab; generator version 2; `model=tiny`;
a CPU, 2 cores, cpu, torch 2.13.0, 32.

Missing: mixed seed 1; all_foreground seed 0, 1; all_background seed 1.

| arm | mIoU | SC IoU | small classes | latency, ms | training memory, MiB | steps | minutes of training |
| --- | --- | --- | --- | --- | --- | --- | --- |
| `mixed` | 14.8 | 40.0 | 6.00 | 400 | 1000 | 40 | 10 |
| `all_foreground` | - | - | - | - | - | - | - |
"""  # noqa: E501
