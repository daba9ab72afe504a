"""A summary of a sweep: which runs it finds, their order, what differed, and their pictures."""

import csv
import json

import cv2
import pytest
import torch
from omegaconf import OmegaConf

from occdetr.cli.folders import taken
from occdetr.summarize import complete_overrides
from occdetr.summarize.runs import find_runs
from programs import newest, program, read_json, the_error

CONFIG = {"stage_name": "full", "monitor": "val/mIoU", "optimizer": {"lr": 1e-3}, "seed": 0}


def make_run(folder, *overrides, figures=(), finished=True, **settings):
    """The files of a training with a validation every 10 steps; returns its folder."""
    folder.mkdir(parents=True)
    given = [text for text in overrides if "=" in text and "stage=" not in text]
    config = OmegaConf.merge({**CONFIG, **settings}, OmegaConf.from_dotlist(given))
    OmegaConf.save(config, folder / "config.yaml")
    (folder / ".hydra").mkdir()
    (folder / ".hydra/occdetr.json").write_text('{"entry": "train"}')
    OmegaConf.save(list(overrides), folder / ".hydra/overrides.yaml")
    choices = {"model": settings.get("model_name", "tiny")}
    OmegaConf.save({"runtime": {"choices": choices}}, folder / ".hydra/hydra.yaml")
    validations = [{"step": 10 * n, "mIoU": v, "AP50": 1 - v} for n, v in enumerate(figures, 1)]
    if finished:
        summary = {"steps": 10 * len(figures), "seconds": 60.0, "validations": validations}
        (folder / "metrics.json").write_text(json.dumps(summary))
    elif validations:
        record = {"ValidationRecord": {"validations": validations}}
        torch.save({"callbacks": record}, folder / "last.ckpt")
    return folder


@pytest.fixture
def sweep(tmp_path):
    """Four finished runs, and what else lies beside them."""
    place = tmp_path / "outputs/full"
    make_run(place / "a_0", "optimizer.lr=1e-3", "seed=1", figures=[0.1, 0.3, 0.2])
    make_run(place / "a_1", "optimizer.lr=2e-3", "seed=1", figures=[0.1, 0.2, 0.4])
    make_run(place / "a_2", "seed=1", "model=small", figures=[0.2], model_name="small")
    make_run(place / "a_3", "optimizer.lr=4e-3", "seed=1", figures=[0.25], finished=False)
    (place / "notes").mkdir()
    return place


def summary_of(tmp_path, *given):
    assert program("summarize", *given, f"outputs={tmp_path}/out") == 0
    return newest(tmp_path, "out/summarize/*/summary.json").parent


def test_runs_are_sorted_and_what_differs_is_shown(sweep, tmp_path, capsys):
    folder = summary_of(tmp_path, f"runs={sweep}")
    out = capsys.readouterr().out
    rows = list(csv.DictReader((folder / "summary.csv").open()))
    assert [row["run"] for row in rows] == ["a_1", "a_0", "a_3", "a_2"]
    assert [row["best mIoU"] for row in rows] == ["0.4", "0.3", "0.25", "0.2"]
    assert [row["best step"] for row in rows] == ["30", "20", "10", "10"]
    assert [row["last mIoU"] for row in rows] == ["0.4", "0.2", "0.25", "0.2"]
    assert [row["optimizer.lr"] for row in rows] == ["0.002", "0.001", "0.004", "0.001"]
    assert [row["model"] for row in rows] == ["tiny", "tiny", "tiny", "small"]
    assert "seed" not in rows[0]  # the same for all
    assert [row["state"] for row in rows] == ["finished"] * 2 + ["unfinished", "finished"]
    assert read_json(folder / "summary.json")["runs"][0]["optimizer.lr"] == 0.002
    assert out.index("a_1") < out.index("a_0") < out.index("a_3") < out.index("a_2")
    assert "40.00" in out
    assert "3 finished, 1 unfinished" in out
    picture = cv2.imread(str(folder / "summary.png"))
    curve = (picture == (178, 114, 0)).all(axis=-1)  # the colour of the best run, BGR
    assert curve[: len(curve) // 2, 65:].any()


def test_another_metric_gives_another_order(sweep, tmp_path, capsys):
    folder = summary_of(tmp_path, f"{sweep}", "metric=val/AP50")
    rows = read_json(folder / "summary.json")["runs"]
    assert [row["run"] for row in rows] == ["a_0", "a_1", "a_2", "a_3"]
    assert program("summarize", f"runs={sweep}", "metric=speed", f"outputs={tmp_path}/out") == 2
    assert "metric=speed: no run has it: choose one of mIoU, AP50" in the_error(capsys)


def test_broken_runs_are_listed_last(sweep, tmp_path, capsys):
    (sweep / "a_1/metrics.json").write_text('{"steps": 3')
    (sweep / "a_0/config.yaml").write_text("a: [")
    folder = summary_of(tmp_path, f"runs={sweep}")
    rows = read_json(folder / "summary.json")["runs"]
    assert [row["run"] for row in rows] == ["a_3", "a_2", "a_0", "a_1"]
    problems = {row["run"]: row["problem"] for row in rows}
    assert problems["a_0"] == "config.yaml cannot be read"
    assert problems["a_1"] == "metrics.json cannot be read"
    assert "1 unfinished, 2 broken" in " ".join(capsys.readouterr().out.split())


def test_states_of_runs_that_have_not_finished(sweep):
    make_run(sweep / "b_0", "seed=2", figures=[0.5], finished=False)
    make_run(sweep / "b_1", "seed=2", figures=[0.5, 0.6], resume="allow")  # continues b_0
    make_run(sweep / "b_2", "seed=3", finished=False)
    (sweep / "b_2/last.ckpt").write_text("cut short")
    (sweep / "b_2/.hydra/occdetr.json").unlink()  # as of an older run
    with taken(sweep / "a_3", "train", "runs", again=True):
        states = {run.folder.name: run.state for run in find_runs(f"{sweep}/*_*")}
    finished = dict.fromkeys(("a_0", "a_1", "a_2", "b_1"), "finished")
    others = {"a_3": "running", "b_0": "continued", "b_2": "unfinished"}
    assert states == finished | others


def test_runs_of_both_stages_need_a_metric(sweep, tmp_path, capsys):
    make_run(sweep.parent / "pretrain/b_0", figures=[0.1], monitor="val/AP50")
    assert program("summarize", f"runs={sweep.parent}", f"outputs={tmp_path}/out") == 2
    assert "several (mIoU, AP50): give one" in the_error(capsys)
    folder = summary_of(tmp_path, f"runs={sweep.parent}", "metric=mIoU")
    names = [row["run"] for row in read_json(folder / "summary.json")["runs"]]
    assert names == ["full/a_1", "full/a_0", "full/a_3", "full/a_2", "pretrain/b_0"]


@pytest.mark.parametrize("place", ["nowhere", "outputs/full/notes"])
def test_folders_without_runs_are_refused(place, sweep, tmp_path, capsys):
    given = (f"runs={tmp_path}/{place}", f"outputs={tmp_path}/out")
    assert program("summarize", *given) == 2
    assert f"runs={tmp_path}/{place}: no " in the_error(capsys)


def test_a_folder_is_taken_as_it_is_typed():
    assert complete_overrides(["outputs/full", "metric=AP50"]) == [
        "runs=outputs/full",
        "metric=AP50",
    ]
    assert complete_overrides(["runs=2024 (ö)"]) == ["runs='2024 (ö)'"]
    assert complete_overrides(["--help"]) == ["--help"]
