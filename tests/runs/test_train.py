"""Training runs: sweeps, the files that they leave, initial weights, resuming."""

import pytest
import torch

from occdetr.training import precision
from occdetr.training.checkpoint import read_checkpoint
from programs import SHORT, STREETS, newest, program, read_json, subprogram, the_error


def data_settings(streets, outputs):
    return (*STREETS, f"data.root={streets}", f"outputs={outputs}")


def test_full_training_of_a_sweep_starts_from_its_pretraining(runs, checkpoint):
    pretrained = read_checkpoint(newest(runs, "pretrain/*/last.ckpt"))
    full = read_checkpoint(checkpoint)
    assert (pretrained.stage, full.stage) == ("pretrain", "full")
    assert full.config["model_name"] == "tiny"
    name = "backbone.blocks.0.project.0.weight"
    step = (full.model_state[name] - pretrained.model_state[name]).abs().max()
    assert 0 < step < 1e-3  # one step away, not another initialisation


@pytest.mark.parametrize("stage", ["pretrain", "full"])
def test_run_leaves_its_files(runs, stage):
    folder = newest(runs, f"{stage}/*/last.ckpt").parent
    names = {path.name for path in folder.iterdir()}
    assert {"config.yaml", "last.ckpt", "best.ckpt", "metrics.json", "tensorboard"} <= names
    assert not list(folder.glob(".*.tmp"))
    assert list((folder / "tensorboard").glob("events*"))
    summary = read_json(folder / "metrics.json")
    assert summary["steps"] == 1
    best = summary["best"]
    assert best["value"] == summary["metrics"][best["metric"]]  # of the only validation


def test_full_training_without_pretraining_names_both_solutions(streets, tmp_path, capsys):
    assert program("train", "stage=full", *SHORT, *data_settings(streets, tmp_path)) == 2
    line = the_error(capsys)
    assert "stage=pretrain" in line
    assert "init_from=scratch" in line


def test_pretraining_of_another_model_is_refused(runs, streets, capsys):
    given = ("stage=full", *SHORT, *data_settings(streets, runs), "attention.hidden_dim=64")
    assert program("train", *given) == 2
    assert "no pretraining of model=tiny" in the_error(capsys)
    other = newest(runs, "pretrain/*/last.ckpt")
    assert program("train", *given, f"init_from={other}") == 2
    assert "hidden_dim=96, this run has 64" in the_error(capsys)


def test_run_resumes(runs, streets, tmp_path, capsys, monkeypatch):
    """Also one that leaves the precision open: it goes on in float32, as it began."""
    monkeypatch.setattr(precision, "_choose", None)  # would time bf16
    data = data_settings(streets, runs)
    place = f"hydra.run.dir={tmp_path}/run"
    longer = ("stage=pretrain", *SHORT, "trainer.max_epochs=2", "trainer.precision=auto")
    assert program("train", *longer, *data, place, "resume=auto") == 0
    printed = capsys.readouterr().out
    assert "resuming: " in printed
    assert "resume: trainer.precision" not in printed
    assert "trainer.precision=auto: " not in printed
    assert read_json(tmp_path / "run/metrics.json")["steps"] == 2
    assert program("train", "stage=pretrain", *SHORT, *data, "resume=auto") == 2
    assert "that run has finished: raise trainer.max_epochs (now 1)" in the_error(capsys)
    other = ("attention.hidden_dim=64", "resume=auto")
    assert program("train", "stage=pretrain", *SHORT, *data, *other) == 2
    assert "resume=auto: no run of stage=pretrain" in the_error(capsys)
    wrong = newest(runs, "pretrain/*/last.ckpt")
    assert program("train", "stage=full", *SHORT, *data, f"resume={wrong}") == 2
    assert "it is of stage=pretrain" in the_error(capsys)


@pytest.mark.parametrize("setting", ["resume", "init_from"])
@pytest.mark.parametrize("place", ["model.encoder", "module.optimizer", "data"])
def test_nothing_is_built_from_a_hostile_checkpoint(
    setting, place, runs, streets, tmp_path, capsys
):
    stage = {"resume": "pretrain", "init_from": "full"}[setting]
    raw = torch.load(newest(runs, "pretrain/*/last.ckpt"), weights_only=True)
    node = raw["hyper_parameters"]
    for name in place.split("."):
        node = node[name]
    node |= {"_target_": "pathlib.Path.touch", "self": {"_target_": "pathlib.Path"}}
    torch.save(raw, tmp_path / "bad.ckpt")
    given = (f"stage={stage}", *SHORT, *data_settings(streets, tmp_path))
    assert program("train", *given, f"{setting}={tmp_path}/bad.ckpt") == 2
    assert "_target_=pathlib.Path" in the_error(capsys)


def test_weights_that_do_not_fit_are_refused(runs, streets, tmp_path, capsys):
    raw = torch.load(newest(runs, "pretrain/*/last.ckpt"), weights_only=True)
    state = raw["state_dict"]
    given = ("stage=full", *SHORT, *data_settings(streets, tmp_path))
    state["model.encoder.level_embed"] = state["model.encoder.level_embed"][:1]
    torch.save(raw, tmp_path / "shape.ckpt")
    assert program("train", *given, f"init_from={tmp_path}/shape.ckpt") == 2
    assert "1 weights have another shape, first encoder.level_embed: [1, " in the_error(capsys)
    raw["state_dict"] = {name: v for name, v in state.items() if ".detector." not in name}
    del raw["state_dict"]["model.encoder.level_embed"]
    torch.save(raw, tmp_path / "part.ckpt")
    assert program("train", *given, f"init_from={tmp_path}/part.ckpt") == 2
    assert "weights of the encoder, first encoder.level_embed: give a whole" in the_error(capsys)


def test_resuming_needs_a_run(streets, tmp_path, capsys):
    data = data_settings(streets, tmp_path)
    assert program("train", "stage=pretrain", *SHORT, *data, "resume=auto") == 2
    assert "resume=auto: no run of stage=pretrain" in the_error(capsys)


def test_another_partition_starts_from_the_same_pretraining(runs, streets, tmp_path, capsys):
    start = f"init_from={newest(runs, 'pretrain/*/last.ckpt')}"
    data = (*data_settings(streets, runs), f"hydra.run.dir={tmp_path}/run", start)
    assert program("train", "stage=full", "partition=all_background", *SHORT, *data) == 0
    out = capsys.readouterr().out
    assert "init_from: loaded " in out
    assert "(backbone (" in out
    assert "mask_head (" in out.partition("; new: ")[2].partition(";")[0]
    assert "not used: detector (" in out
    given = (f"checkpoint={tmp_path}/run/last.ckpt", f"hydra.run.dir={tmp_path}/eval")
    assert program("evaluate", *given) == 0
    metrics = read_json(tmp_path / "eval/metrics.json")
    assert (metrics["num_frames"], metrics["mAP"], metrics["objects_found"]) == (3, 0.0, {})


@pytest.mark.slow
def test_two_ranks_train_both_stages(streets, tmp_path):
    short = [text for text in SHORT if text != "trainer=cpu"]
    given = ("trainer=ddp", "trainer.accelerator=cpu", *short, *data_settings(streets, tmp_path))
    done = subprogram("train", "-m", "stage=pretrain,full", *given)
    assert done.returncode == 0, done.stderr
    for stage in ("pretrain", "full"):
        assert read_json(newest(tmp_path, f"{stage}/*/metrics.json"))["steps"] == 1
