"""The entry points as a person uses them: the whole road on a few small streets, and mistakes."""

import json
import os
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import torch
from occdetr.streets.moment import Camera

from occdetr.classes import CLASS_NAMES
from occdetr.cli import entry as cli
from occdetr.data.frames import find_frames
from occdetr.data.semantickitti import read_labels, read_raw_labels
from occdetr.drawing.confusion import draw_confusion
from occdetr.errors import InputError
from occdetr.evaluation.recall import BANDS
from occdetr.evaluation.substitution import PARTS
from occdetr.evaluation.upper_bound import LOSSES
from occdetr.streets.writer import GENERATOR_VERSION, write_streets
from occdetr.training.checkpoint import read_checkpoint
from programs import newest, program, subprogram, the_error
from reference_completion import evaluate_folders

PICTURE_SIZE = (124, 410)
STREETS = (
    *("data.num_train=2", "data.num_val=3", f"data.street_image_size={list(PICTURE_SIZE)}"),
    *("data.num_workers=0", "data.write_workers=1"),
)
SHORT = ("model=tiny", "image_size=[64,208]", "trainer=cpu", "trainer.max_epochs=1")


@pytest.fixture(scope="session")
def streets(tmp_path_factory):
    """A dataset of 2 + 3 streets; to be read only."""
    root = tmp_path_factory.mktemp("streets")
    write_streets(root, 2, 3, camera=Camera(PICTURE_SIZE), progress=False)
    return root


@pytest.fixture(scope="session")
def road(streets, tmp_path_factory):
    """Where a sweep over both stages has left its runs."""
    outputs = tmp_path_factory.mktemp("outputs")
    data = (*STREETS, f"data.root={streets}", f"outputs={outputs}")
    assert program("train", "-m", "stage=pretrain,full", *SHORT, *data) == 0
    return outputs


@pytest.fixture(scope="session")
def checkpoint(road):
    return newest(road, "full/*/last.ckpt")


@pytest.fixture(scope="session")
def varied_checkpoint(checkpoint, tmp_path_factory):
    """A network that predicts every class somewhere and finds objects everywhere."""
    raw = torch.load(checkpoint, weights_only=True)
    generator = torch.Generator().manual_seed(0)
    for name, value in raw["state_dict"].items():
        if name.startswith("model.mask_head") and value.ndim > 1:
            value += torch.randn(value.shape, generator=generator) * value.std() * 4
        if "class_heads" in name:
            value += torch.randn(value.shape, generator=generator) * 0.5
            value += 3.0 * name.endswith("bias")
    path = tmp_path_factory.mktemp("varied") / "varied.ckpt"
    torch.save(raw, path)
    return path


# --------------------------------------------------------------------------------- the road


def test_a_sweep_runs_both_stages_and_the_second_starts_from_the_first(road, checkpoint):
    pretrained = read_checkpoint(newest(road, "pretrain/*/last.ckpt"))
    full = read_checkpoint(checkpoint)
    assert (pretrained.stage, full.stage) == ("pretrain", "full")
    assert full.config["model_name"] == "tiny"
    name = "backbone.layer1.0.conv1.weight"
    step = (full.model_state[name] - pretrained.model_state[name]).abs().max()
    assert 0 < step < 1e-3  # one or two steps away, not another initialisation


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_a_run_leaves_its_files(road, stage):
    folder = newest(road, f"{stage}/*/last.ckpt").parent
    names = {path.name for path in folder.iterdir()}
    assert {"config.yaml", "last.ckpt", "best.ckpt", "metrics.json", "tensorboard"} <= names
    assert not list(folder.glob(".*.tmp"))
    assert list((folder / "tensorboard").glob("events*"))
    summary = json.loads((folder / "metrics.json").read_text())
    assert summary["steps"] == 1
    assert summary["best"]["metric"] in summary["metrics"]


def test_full_training_without_pretraining_says_both_ways_on(streets, tmp_path, capsys):
    data = (*STREETS, f"data.root={streets}", f"outputs={tmp_path}")
    assert program("train", "stage=full", *SHORT, *data) == 2
    line = the_error(capsys)
    assert "stage=pretrain" in line
    assert "init_from=scratch" in line


def test_pretraining_of_another_model_is_not_taken(road, streets, capsys):
    data = (*STREETS, f"data.root={streets}", f"outputs={road}")
    assert program("train", "stage=full", *SHORT, *data, "hidden_dim=64") == 2
    assert "no pretraining of model=tiny" in the_error(capsys)
    other = newest(road, "pretrain/*/last.ckpt")
    given = f"init_from={other}"
    assert program("train", "stage=full", *SHORT, *data, "hidden_dim=64", given) == 2
    assert "hidden_dim=96, this run has 64" in the_error(capsys)


def test_a_run_resumes(road, streets, tmp_path, capsys):
    data = (*STREETS, f"data.root={streets}", f"outputs={road}", f"hydra.run.dir={tmp_path}/run")
    longer = ("stage=pretrain", *SHORT, "trainer.max_epochs=2")
    assert program("train", *longer, *data, "resume=auto") == 0
    assert "resuming: " in capsys.readouterr().out
    assert json.loads((tmp_path / "run/metrics.json").read_text())["steps"] == 2
    assert program("train", "stage=pretrain", *SHORT, *data[:-1], "resume=auto") == 2
    assert "that run has finished: raise trainer.max_epochs (now 1)" in the_error(capsys)
    other = ("partition=all_foreground", "resume=auto")
    assert program("train", "stage=pretrain", *SHORT, *data, *other) == 2
    assert "resume=auto: no run of stage=pretrain" in the_error(capsys)
    wrong = newest(road, "pretrain/*/last.ckpt")
    assert program("train", "stage=full", *SHORT, *data, f"resume={wrong}") == 2
    assert "it is of stage=pretrain" in the_error(capsys)


def test_another_partition_starts_from_the_same_pretraining(road, streets, tmp_path):
    data = (*STREETS, f"data.root={streets}", f"outputs={road}", f"hydra.run.dir={tmp_path}/run")
    background = ("stage=full", "partition=all_background")
    assert program("train", *background, *SHORT, *data) == 0
    given = (f"checkpoint={tmp_path}/run/last.ckpt", f"hydra.run.dir={tmp_path}/eval")
    assert program("evaluate", *given) == 0
    metrics = json.loads((tmp_path / "eval/metrics.json").read_text())
    assert (metrics["num_frames"], metrics["mAP"], metrics["objects_found"]) == (3, 0.0, {})


def test_resume_without_a_run_says_so(streets, tmp_path, capsys):
    data = (*STREETS, f"data.root={streets}", f"outputs={tmp_path}")
    assert program("train", "stage=pretrain", *SHORT, *data, "resume=auto") == 2
    assert "resume=auto: no run of stage=pretrain" in the_error(capsys)


def test_evaluation_equals_the_reference_on_one_and_two_ranks(varied_checkpoint, streets, tmp_path):
    """Three frames, so that two ranks have unequal shares."""
    given = (f"checkpoint={varied_checkpoint}", "save_predictions=true", "trainer=cpu")
    one, two = tmp_path / "one", tmp_path / "two"
    assert program("evaluate", *given, f"hydra.run.dir={one}") == 0
    ranks = ("trainer.devices=2", "trainer.strategy=ddp", f"hydra.run.dir={two}")
    done = subprogram("evaluate", *given, *ranks)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((one / "metrics.json").read_text())
    assert json.loads((two / "metrics.json").read_text()) == metrics
    assert metrics["num_frames"] == 3
    assert 0 < metrics["mIoU"] < metrics["mIoU_present"]
    assert set(metrics) >= {"mAP", "AP50", "recall3d_25"}
    for folder in (one, two):
        expected = evaluate_folders(streets, folder / "predictions", ["08"])
        assert {key: metrics[key] for key in ("mIoU", "IoU", "precision", "recall")} == {
            key: expected[key] for key in ("mIoU", "IoU", "precision", "recall")
        }
        assert [metrics["per_class"][name] for name in CLASS_NAMES[1:]] == expected["classes"]


def test_evaluation_with_exchanged_pictures(varied_checkpoint, tmp_path, capsys):
    own, other = tmp_path / "own", tmp_path / "other"
    given = (f"checkpoint={varied_checkpoint}", "save_predictions=true")
    assert program("evaluate", *given, f"hydra.run.dir={own}") == 0
    assert program("evaluate", *given, "exchange_images=true", f"hydra.run.dir={other}") == 0
    assert "every frame had the picture of another one" in capsys.readouterr().out
    files = [sorted((folder / "predictions").rglob("*.label")) for folder in (own, other)]
    assert len(files[0]) == len(files[1]) == 3
    assert any(a.read_bytes() != b.read_bytes() for a, b in zip(*files, strict=True))


def test_evaluation_takes_other_data(checkpoint, streets, tmp_path):
    folder = f"hydra.run.dir={tmp_path}"
    data = ("data=semantickitti", f"data.root={streets}", "data.train_sequences=[0]")
    assert program("evaluate", f"checkpoint={checkpoint}", *data, "split=train", folder) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["num_frames"], metrics["split"]) == (1, "train")
    data = ("data=synthetic", *STREETS, f"data.root={streets}")
    assert program("evaluate", f"checkpoint={checkpoint}", *data, folder) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["num_frames"], metrics["split"]) == (3, "val")


def number_of_objects(metrics):
    return sum(b["objects"] for bands in metrics["objects_found"].values() for b in bands.values())


def test_evaluation_tells_near_from_far(varied_checkpoint, streets, tmp_path, capsys):
    folder = tmp_path / "run"
    assert program("evaluate", f"checkpoint={varied_checkpoint}", f"hydra.run.dir={folder}") == 0
    metrics = json.loads((folder / "metrics.json").read_text())
    assert list(metrics["by_distance"]) == list(BANDS)
    assert all(0 < scores["IoU"] < 1 for scores in metrics["by_distance"].values())
    objects = number_of_objects(metrics)
    data = cli.build(cli.compose("train", ["stage=full", *STREETS, f"data.root={streets}"]).data)
    assert objects == sum(len(item.target) for item in data.dataset("val")) > 0
    header, *rows = (folder / "confusion.csv").read_text().splitlines()
    counts = np.array([row.split(",")[1:] for row in rows], dtype=int)  # rows truth
    assert header.split(",")[1:] == list(CLASS_NAMES)
    truth = sum(
        np.bincount(read_labels(frame).ravel(), minlength=256)
        for frame in find_frames(streets, ["08"], stride=5)
    )
    np.testing.assert_array_equal(counts.sum(axis=1), truth[:20])
    assert counts[1:, 1:].sum() / (counts.sum() - counts[0, 0]) == pytest.approx(metrics["IoU"])
    assert cv2.imread(str(folder / "confusion.png")).shape == draw_confusion(counts.T).shape
    shown = capsys.readouterr().out
    assert all(band in shown for band in BANDS)
    assert "objects found, in %" in shown


def test_evaluation_says_what_to_work_on(varied_checkpoint, tmp_path, capsys):
    given = (f"checkpoint={varied_checkpoint}", "diagnose=true", "trainer=cpu")
    one, two = tmp_path / "one", tmp_path / "two"
    assert program("evaluate", *given, f"hydra.run.dir={one}") == 0
    shown = capsys.readouterr().out
    report = json.loads((one / "diagnosis.json").read_text())
    metrics = json.loads((one / "metrics.json").read_text())
    assert report["num_frames"] == 3
    assert report["as_predicted"] == {key: metrics[key] for key in report["as_predicted"]}
    assert list(report["alone"]) == list(report["together"]) == list(PARTS)
    assert report["alone"]["detections"] == report["together"]["detections"]
    objects = sum(sum(fates.values()) - fates["false"] for fates in report["objects"].values())
    assert objects == number_of_objects(metrics)
    best = max(PARTS, key=lambda part: report["alone"][part]["mIoU"])
    assert report["advice"].startswith(f"Work on the {best}: ")
    assert " ".join(report["advice"].split()) in " ".join(shown.split())
    folder = f"hydra.run.dir={tmp_path}/oracle"
    assert program("evaluate", f"checkpoint={varied_checkpoint}", "oracle=true", folder) == 0
    ceiling = json.loads((tmp_path / "oracle/oracle.json").read_text())["variants"]["all"]
    last = report["together"]["background classes"]
    assert last == {key: ceiling[key] for key in last}
    ranks = ("trainer.devices=2", "trainer.strategy=ddp", f"hydra.run.dir={two}")
    done = subprogram("evaluate", *given, *ranks)
    assert done.returncode == 0, done.stderr
    assert json.loads((two / "diagnosis.json").read_text()) == report


def test_a_diagnosis_of_pretraining_says_that_its_voxels_are_chance(road, tmp_path, capsys):
    pretrained = newest(road, "pretrain/*/last.ckpt")
    given = (f"checkpoint={pretrained}", "diagnose=true", f"hydra.run.dir={tmp_path}")
    assert program("evaluate", *given) == 0
    assert "the voxels are those of chance" in capsys.readouterr().out
    report = json.loads((tmp_path / "diagnosis.json").read_text())
    assert report["together"]["background classes"]["IoU"] > report["as_predicted"]["IoU"]
    assert program("evaluate", *given, "oracle=true") == 2
    assert "leave out oracle=true" in the_error(capsys)


def test_evaluation_tells_the_ceilings(streets, tmp_path, capsys):
    settings = ("oracle=true", "data=synthetic", f"data.root={streets}", f"outputs={tmp_path}")
    assert program("evaluate", *settings, *STREETS, "model=tiny") == 0
    report = json.loads(newest(tmp_path, "evaluate/*/oracle.json").read_text())
    assert (report["model"], report["num_frames"]) == ("tiny", 3)
    assert list(report["variants"]) == ["none", *LOSSES, "all"]
    assert 0.8 < report["variants"]["all"]["mIoU_present"] <= 1
    assert program("evaluate", *settings, *STREETS) == 2
    assert "say whose ceiling" in capsys.readouterr().err


def test_a_survey_of_streets(tmp_path, capsys):
    """Its figures are those of the labels that are written, whatever the number of processes."""
    small = ("worlds=3", "split=train", "seed=5", "image_size=[64,208]", "sheet=2", "workers=2")
    assert program("survey", *small, f"hydra.run.dir={tmp_path}") == 0
    report = json.loads((tmp_path / "survey.json").read_text())
    assert (report["generator_version"], report["worlds"]) == (GENERATOR_VERSION, 3)
    write_streets(tmp_path / "data", 3, 0, seed=5, camera=Camera((64, 208)), progress=False)
    frames = find_frames(tmp_path / "data", ["00", "01", "02"], stride=5)
    counts = sum(np.bincount(read_labels(frame).ravel(), minlength=256) for frame in frames)
    counts = counts[1:20]
    shares = [report["classes"][name]["share"] for name in CLASS_NAMES[1:]]
    np.testing.assert_allclose(shares, 100 * counts / counts.sum())
    assert 90 < report["agreement"]["surfaces"] <= 100
    sheet = cv2.imread(str(tmp_path / "sheet.jpg"))
    assert sheet.shape[1] == 1500
    assert "occupied, of the grid" in capsys.readouterr().out


@pytest.mark.parametrize("choice", ["model=tiny", "partition=all_background"])
@pytest.mark.parametrize("oracle", ["oracle=false", "oracle=true"])
def test_a_checkpoint_has_its_own_model_and_partition(choice, oracle, tmp_path, capsys):
    given = ("checkpoint=any.ckpt", oracle, choice, f"hydra.run.dir={tmp_path}")
    assert program("evaluate", *given) == 2
    line = the_error(capsys)
    assert f"error: {choice}: only for oracle=true without a checkpoint" in line
    assert line.endswith(f"has its own {choice.split('=')[0]}: leave it out")


def test_prediction_needs_no_labels(varied_checkpoint, streets, tmp_path):
    sequence = streets / "sequences/08"
    given = (f"images={sequence / 'image_2/*.png'}", f"calib={sequence / 'calib.txt'}")
    folder = f"hydra.run.dir={tmp_path}"
    assert program("predict", f"checkpoint={varied_checkpoint}", *given, folder, "device=cpu") == 0
    entries = json.loads((tmp_path / "predictions.json").read_text())["images"]
    assert [entry["label"] for entry in entries] == ["000000.label", "000005.label", "000010.label"]
    assert all(entry["objects"] for entry in entries)
    for entry in entries:
        assert read_raw_labels(tmp_path / entry["label"]).any()
        assert (tmp_path / entry["picture"]).stat().st_size > 10_000
        left, top, right, bottom = np.array([o["box_xyxy"] for o in entry["objects"]]).T
        assert (right > left).all()
        assert (bottom > top).all()


def test_prediction_equals_evaluation(varied_checkpoint, streets, tmp_path):
    sequence, given = streets / "sequences/08", f"checkpoint={varied_checkpoint}"
    program("evaluate", given, "save_predictions=true", f"hydra.run.dir={tmp_path / 'a'}")
    image = f"images={sequence / 'image_2/000005.png'}"
    calib = f"calib={sequence / 'calib.txt'}"
    program("predict", given, image, calib, f"hydra.run.dir={tmp_path / 'b'}")
    evaluated = tmp_path / "a/predictions/sequences/08/predictions/000005.label"
    np.testing.assert_array_equal(
        read_raw_labels(evaluated), read_raw_labels(tmp_path / "b/000005.label")
    )


def test_prepare_caches_every_frame(streets, tmp_path, capsys):
    given = ("data=semantickitti", f"data.root={streets}", "data.train_sequences=[0,1]")
    place = (f"data.cache_dir={tmp_path / 'cache'}", f"hydra.run.dir={tmp_path / 'run'}")
    for built, rebuild in ((5, False), (0, False), (5, True)):
        run = (*given, *place, "workers=1", f"rebuild={rebuild}")
        assert program("prepare", *run) == 0
        report = json.loads((tmp_path / "run/prepare.json").read_text())
        assert (report["frames"], report["built"]) == (5, built)
        assert report["frames_per_second"] > 0
        seconds, shown = report["seconds_per_frame"], capsys.readouterr().out
        assert f"5 frames ({built} built, {5 - built} already there)" in shown
        assert ("visibility (ray casting)" in shown) == (built > 0)
        if built:
            assert 0 < seconds["clustering"] < seconds["object_labels"] < 1
        else:
            assert set(seconds.values()) == {None}
    assert len(list((tmp_path / "cache").rglob("*.npz"))) == 5


def test_prepare_can_be_split_over_machines(streets, tmp_path):
    given = ("data=semantickitti", f"data.root={streets}", "data.train_sequences=[0,1]")
    place = (f"data.cache_dir={tmp_path / 'cache'}", f"hydra.run.dir={tmp_path / 'run'}")
    built = []
    for shard in ("1/3", "2/3", "3/3", "6/6", "1/1"):
        assert program("prepare", *given, *place, "workers=1", f"shard={shard}") == 0
        report = json.loads((tmp_path / "run/prepare.json").read_text())
        built.append((report["frames"], report["built"]))
    assert built == [(2, 2), (2, 2), (1, 1), (0, 0), (5, 0)]


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_benchmark_measures(precision, tmp_path):
    given = ("model=tiny", "image_size=[64,208]", "device=cpu", "repeats=2", "warmup=1")
    run = (*given, "backward=true", f"precision={precision}", f"hydra.run.dir={tmp_path}")
    assert program("benchmark", *run) == 0
    report = json.loads((tmp_path / "benchmark.json").read_text())
    assert report["precision"] == precision
    assert 10e6 < report["params"] < 20e6
    assert report["macs"] > 1e9
    assert 0 < report["latency_ms"] < report["training_latency_ms"]
    assert report["peak_memory_mb"] > 100
    low, high = report["latency_ms_quartiles"]
    assert low <= report["latency_ms"] <= high


@pytest.mark.parametrize("workers", [0, 1])
def test_benchmark_measures_the_loaders(workers, streets, tmp_path):
    data = ("data=semantickitti", f"data.root={streets}", "data.train_sequences=[0,1]")
    given = ("part=loader", "model=tiny", *data, f"data.num_workers={workers}", "batch_size=2")
    quick = ("repeats=2", "warmup=1", "samples=4", f"hydra.run.dir={tmp_path}")
    assert program("benchmark", *given, *quick) == 0
    report = json.loads((tmp_path / "benchmark.json").read_text())
    assert (report["frames"], report["workers"], report["batch_size"]) == (2, workers, 2)
    for name in ("plain", "augmented"):
        low, high = report[name]["quartiles"]
        assert 0 < low <= report[name]["samples_per_second_per_worker"] <= high


# ----------------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("entry", "override", "expected"),
    [
        ("train", "model=huge", "model=huge: no such option: choose one of paper, small, tiny"),
        ("train", "stage=fll", "choose one of full, pretrain"),
        ("train", "experiment=none_such", "no such option: choose one of convergence/early_"),
        ("train", "modle=tiny", "modle: no such setting: did you mean"),
        ("train", "trainer.max_epoch=3", "did you mean trainer.max_epochs"),
        ("train", "data.rot=x", "data.rot: no such setting: did you mean data.root"),
        ("train", "trainer.max_epochs=many", "must be a number such as 50"),
        ("train", "trainer.accelerator=abacus", "trainer: "),
        ("train", "trainer.precision=3", "trainer: "),
        ("train", "model", "'model' cannot be read"),
        ("train", "model=null", "a group takes the name of an option"),
        ("train", "image_size=[128]", "image_size=[128]: must be [height, width]"),
        ("train", "image_size=[32,32]", "fewer than the 100 queries"),
        ("train", "image_size=big", "must be a list such as [128, 416]"),
        ("train", "data.batch_size=0", "data.batch_size=0: give 1 or more"),
        ("train", "+data.objects.distance.cat=1", "unknown class 'cat'"),
        ("train", "+model.colour=red", "unexpected keyword argument 'colour'"),
        ("train", "resume=nowhere.ckpt", "nowhere.ckpt: no such file"),
        ("evaluate", "split=val", "checkpoint is not set: give it, as in checkpoint=outputs/"),
        ("evaluate", "checkpoint=nowhere.ckpt", "nowhere.ckpt: no such file"),
        ("evaluate", "model=tiny", "model=tiny: only for oracle=true without a checkpoint"),
        ("predict", "checkpoint=nowhere.ckpt", "images is not set"),
        ("benchmark", "device=abacus", "device=abacus: unknown device"),
        ("benchmark", "part=wheel", "part=wheel: choose one of model, loader"),
        ("benchmark", "precision=8-true", "choose one of auto, 32-true, bf16-mixed"),
        ("prepare", "shard=4/3", "shard=4/3: give i/n, the i-th of n machines, as in shard=3/16"),
        ("prepare", "shard=0/3", "shard=0/3: give i/n"),
        ("prepare", "shard=third", "shard=third: give i/n"),
        ("prepare", "workers=-1", "workers=-1: give 0 (one for each core) or more"),
        ("survey", "worlds=0", "worlds=0: give 1 or more"),
        ("survey", "split=test", "split=test: choose one of train, val"),
        ("survey", "image_size=[8,200]", "image_size=[8, 200]: give 32 pixels or more"),
        ("visualize", "streets", "what=streets: no such pictures: use labels"),
        ("visualize", "split=test", "split=test: labels exist for train and val"),
        ("visualize", "width=9", "width=9: give 320 pixels or more"),
    ],
)
def test_a_wrong_setting_is_told_in_one_line(entry, override, expected, tmp_path, capsys):
    assert program(entry, override, f"hydra.run.dir={tmp_path}/run") == 2
    assert expected in the_error(capsys)


def copy_of(streets, folder):
    """A dataset to be spoiled: sequence 00 for training, 08 for validation."""
    for file in streets.glob("sequences/0[08]/**/*"):
        if file.is_file():
            goal = folder / file.relative_to(streets)
            goal.parent.mkdir(parents=True, exist_ok=True)
            os.link(file, goal)
    return folder


def replace(path, data):
    path.unlink()  # it may be a link to the real one
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


@pytest.mark.parametrize("spoil", [truncate_label, drop_tr, shrink_picture, drop_sequence])
@pytest.mark.parametrize("workers", [0, 1])
def test_a_spoilt_dataset_is_told_in_one_line(spoil, workers, streets, tmp_path, capfd):
    root = copy_of(streets, tmp_path / "data")
    expected = spoil(root)
    data = ("data=semantickitti", f"data.root={root}", "data.train_sequences=[0]")
    given = (*SHORT, *data, f"data.num_workers={workers}", f"outputs={tmp_path}")
    assert program("train", "stage=pretrain", *given) == 2
    assert expected in the_error(capfd)


def test_a_missing_folder_is_told_in_one_line(tmp_path, capsys):
    given = ("data=semantickitti", f"data.root={tmp_path}/nowhere", f"outputs={tmp_path}")
    for entry in ("train", "prepare"):
        assert program(entry, *given) == 2
        assert "nowhere: no dataset there" in the_error(capsys)


def test_prediction_names_what_is_wrong(checkpoint, streets, tmp_path, capsys):
    sequence, folder = streets / "sequences/08", f"hydra.run.dir={tmp_path}/run"
    images, calib = sequence / "image_2", sequence / "calib.txt"
    given = (f"checkpoint={checkpoint}", folder)
    assert program("predict", *given, f"images={tmp_path}/*.png", f"calib={calib}") == 2
    assert "no image there" in the_error(capsys)
    assert program("predict", *given, f"images={images}", f"calib={tmp_path}/calib.txt") == 2
    assert "calib.txt: calibration file is missing" in the_error(capsys)
    assert program("predict", *given, f"images={images}", "calib=null") == 2
    assert "calib is not set" in the_error(capsys)


def test_a_broken_checkpoint_is_told_in_one_line(checkpoint, tmp_path, capsys):
    broken = tmp_path / "broken.ckpt"
    broken.write_bytes(checkpoint.read_bytes()[:10_000])
    assert program("evaluate", f"checkpoint={broken}", f"hydra.run.dir={tmp_path}") == 2
    assert "not a readable checkpoint" in the_error(capsys)


def test_a_defect_keeps_its_traceback(tmp_path, monkeypatch, capsys):
    @cli.entry_point("predict")
    def main(config):
        raise RuntimeError("a defect")

    monkeypatch.setattr(sys, "argv", ["predict.py", f"hydra.run.dir={tmp_path}"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-1] == "RuntimeError: a defect"


@pytest.mark.parametrize(("raised", "code"), [(InputError("mend it"), 2), (KeyboardInterrupt, 130)])
def test_exit_codes(raised, code, tmp_path, monkeypatch, capsys):
    @cli.entry_point("predict")
    def main(config):
        raise raised

    monkeypatch.setattr(sys, "argv", ["predict.py", f"hydra.run.dir={tmp_path}"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == code
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


# ------------------------------------------------------------------------------ the long ones


@pytest.mark.slow
def test_interruption_leaves_whole_files(streets, tmp_path):
    data = (*STREETS, f"data.root={streets}", f"outputs={tmp_path}")
    command = ["-m", "occdetr.train", "stage=pretrain", *SHORT, *data, "trainer.max_epochs=1000"]
    process = subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    end = time.monotonic() + 120
    while not list(tmp_path.glob("pretrain/*/last.ckpt")) and time.monotonic() < end:
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.strip().splitlines()[-1] == "interrupted"
    assert read_checkpoint(newest(tmp_path, "pretrain/*/last.ckpt")).stage == "pretrain"
    assert not list(tmp_path.glob("pretrain/*/.*.tmp"))


@pytest.mark.slow
@pytest.mark.parametrize(("stop", "after"), [("Ctrl-C", 1), ("Ctrl-C", 10), ("kill", 10)])
def test_a_stopped_preparation_goes_on(stop, after, streets, tmp_path):
    """After 1 frame the workers are starting, after 10 they are at work."""
    source, goal, count = streets / "sequences/00", tmp_path / "data/sequences/00", 200
    for folder in ("image_2", "voxels"):
        (goal / folder).mkdir(parents=True)
    os.link(source / "calib.txt", goal / "calib.txt")
    for number in range(count):  # one street under many numbers
        for file in source.glob("*/000000.*"):
            os.link(file, goal / file.parent.name / f"{5 * number:06d}{file.suffix}")
    data = ("data=semantickitti", f"data.root={tmp_path / 'data'}", "data.train_sequences=[0]")
    given = (*data, "data.val_sequences=[0]", f"hydra.run.dir={tmp_path / 'run'}")
    process = subprocess.Popen(
        [sys.executable, "-m", "occdetr.prepare", *given, "workers=2"],
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True},
        start_new_session=True,  # a process group of its own, as a terminal gives
    )
    end = time.monotonic() + 120
    while len(list(tmp_path.glob("data/**/*.npz"))) < after and time.monotonic() < end:
        time.sleep(0.05)
    if stop == "Ctrl-C":
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.kill()
    out, errors = process.communicate(timeout=60)  # which ends when the last worker has ended
    if stop == "Ctrl-C":
        assert (process.returncode, errors.strip()) == (130, "interrupted")
        assert "stopped after" in out
    there = len(list(tmp_path.glob("data/**/*.npz")))
    assert after <= there < count
    assert program("prepare", *given, "workers=1") == 0
    report = json.loads((tmp_path / "run/prepare.json").read_text())
    assert (report["reused"], report["built"]) == (there, count - there)


@pytest.mark.slow
def test_two_ranks_train_both_stages(streets, tmp_path):
    data = (*STREETS, f"data.root={streets}", f"outputs={tmp_path}")
    short = [text for text in SHORT if text != "trainer=cpu"]
    given = ("trainer=ddp", "trainer.accelerator=cpu", *short, *data)
    done = subprogram("train", "-m", "stage=pretrain,full", *given)
    assert done.returncode == 0, done.stderr
    for stage in ("pretrain", "full"):
        summary = json.loads(newest(tmp_path, f"{stage}/*/metrics.json").read_text())
        assert summary["steps"] == 1


@pytest.mark.slow
def test_the_demo_ends_with_a_table_and_a_picture(streets, tmp_path):
    few = ("trainer.max_epochs=1", "image_size=[64,208]", f"data.root={streets}", *STREETS)
    overrides = ",".join(f"'{text}'" for text in few)
    done = subprogram("demo", f"folder={tmp_path}", f"overrides=[{overrides}]")
    assert done.returncode == 0, done.stderr
    assert "position baseline" in done.stdout
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert {"mIoU", "IoU", "precision", "recall", "per_class", "mAP", "AP50"} <= set(metrics)
    assert 0 < metrics["baseline"]["mIoU"] < metrics["baseline"]["IoU"] < 1
    assert (tmp_path / "prediction.png").stat().st_size > 10_000
