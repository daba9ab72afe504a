"""The page of results is generated from records alone."""

import json
from pathlib import Path

import cv2
import pytest

from occdetr.classes import CLASS_NAMES
from occdetr.files import write_json
from programs import program, the_error

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
    """A record with default values of all keys that ``facts`` does not give."""
    machine = {"cpu": "a CPU", "cores": 2, "device": "cpu", "torch": "2.13.0", "precision": "32"}
    record = {
        **{"study": name, "arm": arm, "seed": seed, "commit": "a" * 40, "dirty": False},
        "command": f"python -m occdetr.study name={name} 'arms=[{arm}]' 'seeds=[{seed}]'",
        **{"code": "0123456789ab", "code_changed": False},
        **{"generator_version": 2, "machine": machine, "model": "tiny", "seconds": 600.0},
        **{"steps": 40, "peak_memory_mb": 1000.0, "curve": []},
        **{"stages": {"pretrain": {"steps": 40}}, **facts},
    }
    write_json(folder / name / f"{arm}_seed{seed}.json", record)


SMALL = ["bicycle", "motorcycle", "person", "bicyclist", "motorcyclist", "pole", "traffic-sign"]


def per_class(small, others):
    """The IoU of each class, one value for the small classes and one for the others."""
    return {name: small if name in SMALL else others for name in CLASS_NAMES[1:]}


@pytest.fixture
def records(tmp_path):
    """The folder of made-up records: all of convergence, some of partition and real."""
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
        stages = ("pretrain", "full") if arm == "mixed" else ("full",)
        steps = 40 * (len(stages) - 1)  # before stage=full
        facts = {"latency": {"latency_ms": 400.4}, "dirty": True}
        facts["stages"] = {stage: {"steps": 40} for stage in stages}
        curve = [{"stage": "full", "step": steps + s, "mIoU": 0.1, "IoU": 0.3} for s in (20, 40)]
        write_record(tmp_path, "partition", arm, 0, figures=figures, curve=curve, **facts)
    for split in range(3):
        figures = {"mIoU_present": 0.1 * split, "IoU": 0.5, "per_class": per_class(0, 0)}
        facts = {"steps": 0, "seconds": 0, "peak_memory_mb": None, "stages": {}}
        write_record(tmp_path, "real", "position", split, figures=figures, **facts)
    for split, miou in ((1, 0.3), (2, 0.1)):
        figures = {"mIoU_present": miou, "IoU": 0.6, "AP50": miou, "per_class": per_class(0, 0)}
        stages = {"full": {"steps": 40}}
        write_record(tmp_path, "real", "finetuned", split, figures=figures, stages=stages)
    return tmp_path


def generate(records, page):
    """Run the entry point. Returns its exit code."""
    places = (f"results={records}", f"page={page}", f"images={records}/images")
    return program("study.results", *places, f"hydra.run.dir={records}")


def block(text, name):
    """The generated lines of a study."""
    return text.split(f"<!-- {name} -->\n")[1].split("<!-- end -->")[0].strip().splitlines()


def test_blocks_are_generated_and_other_text_stays(records, tmp_path, capsys):
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    assert generate(records, page) == 0
    text = page.read_text()
    assert block(text, "convergence") == CONVERGENCE.strip().splitlines()
    assert block(text, "partition")[:9] == PARTITION.strip().splitlines()
    assert "| bicycle | 6.0 | - | 1.5 |" in text
    assert "- mIoU: `mixed` has 1.39 times that of `all_background`." in text
    assert "- small classes: `mixed` has 4.00 times that of `all_background`." in text
    assert "| `position` | 3 | 10.0 ± 10.0 | 50.0 ± 0.0 | - | 0 ± 0 |" in text
    assert "| `finetuned` | 2 | 20.0 ± 14.1 | 60.0 ± 0.0 | 20.0 ± 14.1 | 10 ± 0 |" in text
    assert "| 2 | - | - | 10.0 | 20.0 |" in block(text, "real")
    *_, empty, miou, occupied = block(text, "real")  # position has no AP50
    assert empty == ""
    assert "mIoU: `finetuned` minus `position` is 5.0 ± 21.2; `finetuned` is higher in 1" in miou
    assert "SC IoU: `finetuned` minus `position` is 10.0 ± 0.0; `finetuned` is higher" in occupied
    assert (
        "partition: 2 results; missing: mixed seed 1, 2; all_foreground" in capsys.readouterr().out
    )
    assert "<!-- end -->\n\nBetween.\n\n<!-- partition -->\n`python" in text
    assert text.startswith("# Results\n\nText before.\n\n<!-- convergence -->\n")
    assert text.endswith("<!-- end -->\nAfter.\n")


def test_a_study_with_other_settings_has_a_block_if_the_page_has_its_marker(records, tmp_path):
    overrides = "\"overrides=['data.num_train=9','model=small']\""
    command = f"python -m occdetr.study name=convergence results=larger {overrides}"
    for seed in (0, 1):
        figures = {"AP50": 0.6, "mAP": 0.4, "recall3d_25": 0.3}
        curve = [{"stage": "pretrain", "step": 20, "AP50": 0.6, "mAP": 0.4}]
        chosen = f"{command} 'arms=[mixed]' 'seeds=[{seed}]' rebuild=true"
        facts = {"figures": figures, "curve": curve, "command": chosen}
        write_record(tmp_path / "larger", "convergence", "mixed", seed, **facts)
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE + "\n<!-- larger/convergence -->\nold\n<!-- end -->\n")
    assert generate(records, page) == 0
    lines = block(page.read_text(), "larger/convergence")
    first = " ".join(lines[: lines.index("")])  # wrapped; a space after each comma of a list
    assert first.startswith(f"`{command}`; 2 runs; ".replace("','", "', '"))
    assert max(map(len, lines)) <= 120
    assert "Missing: early_matching seed 0, 1, 2; two_stage seed 0, 1, 2; mixed seed 2." in lines
    assert "| `mixed` | 60.0 ± 0.0 | 40.0 ± 0.0 | 30.0 ± 0.0 | 40 | 10 ± 0 |" in lines
    assert lines[-1] == "![convergence during training](images/larger-convergence.png)"
    assert (records / "images" / "larger-convergence.png").exists()
    assert block(page.read_text(), "convergence") == CONVERGENCE.strip().splitlines()


@pytest.mark.parametrize(("found", "shown"), [(0.0, "0"), (0.00002, "0.002")])
def test_a_ratio_of_more_than_100_is_shown_as_two_values(found, shown, records, tmp_path):
    path = records / "partition" / "all_background_seed0.json"
    record = json.loads(path.read_text())
    record["figures"]["per_class"] |= dict.fromkeys(SMALL, found)
    write_json(path, record)
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    assert generate(records, page) == 0
    assert f"- small classes: `mixed` has 6.00 %, `all_background` {shown} %." in page.read_text()


def test_a_second_run_changes_no_byte(records, tmp_path):
    page, files = tmp_path / "results.md", []
    page.write_text(EMPTY_PAGE)
    for _ in range(2):
        assert generate(records, page) == 0
        pictures = sorted((records / "images").glob("*"))
        files.append([page.read_bytes(), *(path.read_bytes() for path in pictures)])
    assert files[0] == files[1]
    assert [path.name for path in pictures] == ["convergence.png", "partition.png"]
    picture = cv2.imread(str(pictures[0]))
    assert picture.shape[1] > 800
    assert (picture != 255).any(-1).mean() > 0.02  # not an empty page


def test_the_page_without_records(tmp_path):
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    assert generate(tmp_path / "none", page) == 0
    expected = ["No results yet: `python -m occdetr.study name=real`."]
    assert block(page.read_text(), "real") == expected


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        (
            "convergence/broken_seed0.json",
            "{}",
            "early_matching, two_stage, mixed",
        ),
        ("convergence/mixed.json", "{}", "<arm>_seed<k>.json"),
        ("convergence/mixed_seed00.json", "{}", "rename it to <arm>_seed<k>.json"),
        ("convergence/mixed_seed0.json", "{", "mixed_seed0.json"),
        ("real/real_seed0.json", "[1]", "real_seed0.json"),
        ("real/real_seed10.json", "{}", "study real has splits 0 to 9: move it away"),
        ("results.md", EMPTY_PAGE.replace("real", "reel"), "<!-- real -->"),
        ("results.md", EMPTY_PAGE.replace("<!-- end -->\n<", "<"), "<!-- partition -->"),
    ],
)
def test_an_invalid_file_is_reported(name, content, expected, records, tmp_path, capsys):
    (tmp_path / "results.md").write_text(EMPTY_PAGE)
    (tmp_path / name).write_text(content)
    assert generate(records, tmp_path / "results.md") == 2
    assert expected in the_error(capsys)


#: Marks a fact that a record lacks.
ABSENT = object()


@pytest.mark.parametrize(
    ("name", "fact", "value"),
    [
        ("convergence/mixed_seed0", "figures.AP50", ABSENT),
        ("convergence/mixed_seed0", "figures.AP50", None),
        ("convergence/mixed_seed0", "figures.AP50", float("nan")),
        ("convergence/mixed_seed0", "figures.AP50", "x"),
        ("convergence/mixed_seed0", "figures.AP50", True),
        ("convergence/mixed_seed0", "figures", 5),
        ("convergence/mixed_seed0", "machine", {}),
        ("convergence/mixed_seed0", "commit", 5),
        ("convergence/mixed_seed0", "command", "an open ' quote"),
        ("convergence/mixed_seed0", "steps", ABSENT),
        ("convergence/mixed_seed0", "seconds", None),
        ("convergence/mixed_seed0", "stages", {}),
        ("convergence/mixed_seed0", "stages", {"full": {"steps": 40}}),
        ("convergence/mixed_seed0", "stages.pretrain.steps", "many"),
        ("convergence/mixed_seed0", "curve", 5),
        ("convergence/mixed_seed0", "curve", []),
        ("convergence/mixed_seed0", "curve", [5]),
        ("convergence/mixed_seed0", "curve", [{"stage": "pretrain", "step": 20, "AP50": 0.1}]),
        ("partition/mixed_seed0", "stages", {"full": {"steps": 40}, "pretrain": {"steps": 40}}),
        ("partition/mixed_seed0", "curve", [{"stage": "full", "step": 40, "mIoU": 0.1, "IoU": 0}]),
        ("partition/mixed_seed0", "figures.per_class.road", ABSENT),
        ("partition/mixed_seed0", "peak_memory_mb", None),
        ("partition/mixed_seed0", "latency", ABSENT),
        ("real/finetuned_seed1", "figures.AP50", ABSENT),
        ("real/finetuned_seed1", "figures.mIoU_present", None),
    ],
)
def test_a_record_without_what_its_study_shows_is_reported(
    name, fact, value, records, tmp_path, capsys
):
    path = records / f"{name}.json"
    record = json.loads(path.read_text())
    *above, key = fact.split(".")
    node = record
    for part in above:
        node = node[part]
    if value is ABSENT:
        del node[key]
    else:
        node[key] = value
    write_json(path, record)
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    assert generate(records, page) == 2
    line = the_error(capsys)
    assert f"{path}: is not a valid record" in line
    assert key in line
    assert "run that arm again, with rebuild=true" in line
    assert page.read_text() == EMPTY_PAGE


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("convergence/mixed_seed0", "convergence/mixed_seed1"),  # a copy for another seed
        ("convergence/mixed_seed0", "convergence/two_stage_seed0"),
        ("convergence/mixed_seed0", "partition/mixed_seed0"),
    ],
)
def test_the_record_of_another_run_is_not_taken(source, name, records, tmp_path, capsys):
    (records / f"{name}.json").write_bytes((records / f"{source}.json").read_bytes())
    (tmp_path / "results.md").write_text(EMPTY_PAGE)
    assert generate(records, tmp_path / "results.md") == 2
    line = the_error(capsys)
    study, _, arm = name.partition("/")
    arm, _, seed = arm.partition("_seed")
    assert f"{name}.json: is not the record of study {study}, {arm}, seed {seed}: move it" in line


def test_a_missing_folder_of_records_leaves_the_page(records, tmp_path, capsys):
    page = tmp_path / "results.md"
    page.write_text(EMPTY_PAGE)
    given = (f"page={page}", f"images={tmp_path}/images", f"hydra.run.dir={tmp_path}")
    assert program("study.results", f"results={tmp_path}/typo", *given) == 2
    assert f"results={tmp_path}/typo: no such folder" in the_error(capsys)
    assert page.read_text() == EMPTY_PAGE


def test_a_page_that_is_no_text_is_reported(records, tmp_path, capsys):
    page = tmp_path / "results.png"
    page.write_bytes(b"\x89PNG")
    assert generate(records, page) == 2
    assert f"page={page}: is not a text" in the_error(capsys)


def test_a_missing_page_is_reported(records, tmp_path, capsys):
    assert generate(records, tmp_path / "nowhere.md") == 2
    assert "nowhere.md" in the_error(capsys)


def test_the_page_of_this_repository_has_all_markers():
    text = (Path(__file__).parents[2] / "docs" / "results.md").read_text()
    for name in ("convergence", "partition", "real"):
        assert len(block(text, name)) >= 1


CONVERGENCE = """
`python -m occdetr.study name=convergence`; 6 runs; commit aaaaaaa; generator version 2; `model=tiny`; a CPU, 2 cores,
cpu, torch 2.13.0, 32.

Missing: early_matching seed 2; two_stage seed 2; mixed seed 2.

| arm | AP50 | mAP | 3D recall | steps | minutes of training |
| --- | --- | --- | --- | --- | --- |
| `early_matching` | 51.0 ± 1.4 | 25.0 ± 0.0 | 25.0 ± 0.0 | 40 | 10 ± 0 |
| `two_stage` | 31.0 ± 1.4 | 15.0 ± 0.0 | 25.0 ± 0.0 | 40 | 10 ± 0 |
| `mixed` | 61.0 ± 1.4 | 30.0 ± 0.0 | 25.0 ± 0.0 | 40 | 10 ± 0 |

AP50 at each validation:

| step | `early_matching` | `two_stage` | `mixed` |
| --- | --- | --- | --- |
| 20 | 31.0 ± 1.4 | 11.0 ± 1.4 | 21.0 ± 1.4 |
| 40 | 51.0 ± 1.4 | 31.0 ± 1.4 | 61.0 ± 1.4 |

- `early_matching` reaches the last AP50 of `two_stage` (31.0) after 20 of its 40 steps (50 %).
- `early_matching` is above `mixed` at 1 of 2 validations.

![convergence during training](images/convergence.png)
"""  # noqa: E501

PARTITION = """
`python -m occdetr.study name=partition`; 2 runs; commit aaaaaaa, code 0123456789ab; generator version 2; `model=tiny`;
a CPU, 2 cores, cpu, torch 2.13.0, 32.

Missing: mixed seed 1, 2; all_foreground seed 0, 1, 2; all_background seed 1, 2.

| arm | mIoU | SC IoU | small classes | latency, ms | training memory, MiB | steps | minutes of training |
| --- | --- | --- | --- | --- | --- | --- | --- |
| `mixed` | 14.8 | 40.0 | 6.00 | 400 | 1000 | 40 | 10 |
| `all_foreground` | - | - | - | - | - | - | - |
"""  # noqa: E501
