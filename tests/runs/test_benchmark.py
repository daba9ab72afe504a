"""Measurements of a model's size and speed, and of the data loaders'."""

import pytest
from torch._inductor import config as inductor_config

from programs import SMALL, program, read_json, the_error

QUICK = (*SMALL, "device=cpu", "repeats=2", "warmup=1")


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_model(precision, tmp_path):
    run = (*QUICK, f"precision={precision}", f"hydra.run.dir={tmp_path}")
    assert program("benchmark", *run) == 0
    report = read_json(tmp_path / "benchmark.json")
    assert report["precision"] == precision
    assert 4e6 < report["params"] < 5e6
    assert report["macs"] > 5e8
    assert report["scene"]["occupied_voxels"] > 10_000
    assert report["scene"]["objects"] > 1
    assert report["peak_memory_mb"] > report["tensor_memory_mb"] > 1
    low, high = report["latency_ms_quartiles"]
    assert 0 < low <= report["latency_ms"] <= high
    parts = report["parts"]
    whole, rest = parts.pop("whole"), parts.pop("rest")
    assert whole["macs"] == report["macs"] == sum(part["macs"] for part in parts.values())
    assert sum(part["params"] for part in parts.values()) == report["params"]
    assert all(0 < part["share_of_limit"] < 10 for part in parts.values())
    assert rest["latency_ms"] < whole["latency_ms"]
    assert report["limits"]["flops"] > 1e8
    table = (tmp_path / "benchmark.md").read_text()
    assert all(f"| {name.replace('_', ' ')} |" in table for name in (*parts, "rest", "whole"))


@pytest.mark.parametrize("stage", [pytest.param("pretrain", marks=pytest.mark.slow), "full"])
def test_training_step(stage, tmp_path):
    given = ("mode=train", f"stage={stage}", "streets=2", f"hydra.run.dir={tmp_path}")
    assert program("benchmark", *QUICK, *given) == 0
    report = read_json(tmp_path / "benchmark.json")
    phases = report["phases"]
    names = ["forward", "losses", "backward", "clipping", "optimizer"]
    assert all(phases[name]["latency_ms"] > 0 for name in names)
    assert sum(phases[name]["macs"] for name in names) == phases["step"]["macs"]
    assert phases["backward"]["macs"] > phases["forward"]["macs"] > 1e8
    assert phases["optimizer"]["macs"] > 1e8  # Muon's
    assert ("occupancy_decoder" in phases) == (stage == "full")
    weights = phases["clipping"]["least_bytes"]
    assert phases["optimizer"]["least_bytes"] > 5 * weights > 1e6
    assert report["loader"]["cpu_ms_per_sample"] > 0
    assert 0 <= report["loader"]["hidden"] <= 1
    table = (tmp_path / "benchmark.md").read_text()
    assert "| forward: backbone |" in table


def test_scaling(tmp_path):
    curves = ("scaling.objects=[4,8]", "~scaling.slots", "~scaling.kept", "~scaling.image")
    given = ("part=scaling", *curves, "scaling.batch=[1,2]", f"hydra.run.dir={tmp_path}")
    assert program("benchmark", *QUICK, *given) == 0
    report = read_json(tmp_path / "benchmark.json")
    assert list(report["curves"]) == ["batch", "objects"]
    batch = report["curves"]["batch"]
    assert batch["work"] == [1, 2]
    assert batch["fits"]["multiply-adds"] == {
        "exponent": 1.0,
        "last": 1.0,
        "no_worse_than_linear": True,
    }
    assert batch["costs"]["memory"][1] > 1.5 * batch["costs"]["memory"][0]
    assert (tmp_path / "scaling.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["mode=sleep"], "mode=sleep: choose one of predict, train"),
        (["vs=pytorch"], "vs=pytorch: choose one of null, transformers"),
        (["mode=train", "vs=transformers"], "leave out mode=train"),
        (["part=loader", "vs=transformers"], "vs=transformers: part=loader has none"),
        (["part=scaling", "mode=train"], "mode=train: part=scaling has none"),
        (["compile=true"], "compile=true: only beside another project"),
        (["mode=train", "trainer.precision=bf16-mixed"], "give precision=... in its place"),
        (["mode=train", "trainer.devices=2"], "trainer.devices=2: has no effect here"),
        (["part=all", "trainer.max_steps=3"], "trainer.max_steps=3: has no effect here"),
        (["part=scaling", "scaling.slots=[8]"], "scaling.slots=[8]: give two"),
        (["part=scaling", "scaling.kept=[2,1]"], "scaling.kept=[2, 1]: give two"),
        (["part=scaling", "scaling.batch=[]"], "scaling.batch=[]: give two"),
        (["part=scaling", "scaling.kept=[1,inf]"], "scaling.kept=[1, inf]: give two"),
        (["part=scaling", "scaling.kept=[100,1000]"], "kept cells, all layers: give others"),
        (["part=scaling", "scaling.slots=[8,8.5]"], "scaling.slots=[8, 8.5]: give whole numbers"),
        (["part=scaling", "scaling.batch=[1,1e12]"], "give numbers of 1 to 16384"),
        (["part=scaling", "scaling.image=[1,1e9]"], "scaling.image"),
        (["part=scaling", "+scaling.wheels=[1,2]"], "scaling.wheels: choose names of"),
        (["part=scaling", "partition=all_background"], "scaling.slots"),
        (["vs=transformers", "image_size=[64,208]"], "300 of its 278 tokens"),
        (["vs=transformers", "partition=all_background"], "has no detector"),
    ],
)
def test_wrong_settings(given, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("occdetr.benchmark.peer.check_peer", lambda: None)
    assert program("benchmark", *given, f"hydra.run.dir={tmp_path}") == 2
    assert message in the_error(capsys)


def test_a_missing_compiler_is_reported_before_anything_is_measured(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("occdetr.benchmark.peer.Peer", None)
    given = ("vs=transformers", "compile=true", "model=tiny", "device=cpu")
    with inductor_config.patch({"cpp.cxx": ("/nowhere/g++",)}):
        assert program("benchmark", *given, f"hydra.run.dir={tmp_path}") == 2
    assert "error: compile=true: " in the_error(capsys)


@pytest.mark.parametrize("workers", [0, 1])
def test_loaders(workers, streets, tmp_path):
    data = ("data=semantickitti", f"data.root={streets}", "data.train_sequences=[0,1]")
    given = ("part=loader", "model=tiny", *data, f"data.num_workers={workers}", "batch_size=2")
    quick = ("repeats=2", "warmup=1", "samples=4", f"hydra.run.dir={tmp_path}")
    assert program("benchmark", *given, *quick) == 0
    report = read_json(tmp_path / "benchmark.json")
    assert (report["frames"], report["workers"], report["batch_size"]) == (2, workers, 2)
    for name in ("plain", "augmented"):
        low, high = report[name]["quartiles"]
        assert 0 < low <= report[name]["samples_per_second_per_worker"] <= high
