"""Measurements of a model's size and speed, and of the data loaders'."""

import pytest

from programs import SMALL, program, read_json


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_model(precision, tmp_path):
    given = (*SMALL, "device=cpu", "repeats=2", "warmup=1")
    run = (*given, "backward=true", f"precision={precision}", f"hydra.run.dir={tmp_path}")
    assert program("benchmark", *run) == 0
    report = read_json(tmp_path / "benchmark.json")
    assert report["precision"] == precision
    assert 10e6 < report["params"] < 20e6
    assert report["macs"] > 1e9
    assert report["scene"]["occupied_voxels"] > 10_000
    assert report["scene"]["objects"] > 1
    assert 0 < report["latency_ms"] < report["training_latency_ms"]
    assert report["peak_memory_mb"] > 100
    low, high = report["latency_ms_quartiles"]
    assert low <= report["latency_ms"] <= high


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
