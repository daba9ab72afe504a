"""The program that exports: its file, its report, its refusals."""

from __future__ import annotations

import sys

import pytest
import torch

from occdetr import export
from occdetr.export.formats import Format
from occdetr.export.network import OUTPUTS
from programs import program, read_json, the_error


def run(checkpoint, folder, *overrides):
    """Export into ``folder``; returns the exit code."""
    given = (f"checkpoint={checkpoint}", f"hydra.run.dir={folder}", "device=cpu", "repeats=2")
    return program("export", *given, *overrides)


@pytest.mark.slow
def test_a_file_that_runs_without_this_package(varied_checkpoint, tmp_path, capsys):
    path = tmp_path / "given/network.pt2"
    assert run(varied_checkpoint, tmp_path / "run", "format=torch_export", f"output={path}") == 0
    printed = capsys.readouterr().out
    assert "of the voxels have equal class" in printed
    assert "latency: eager" in printed
    assert printed.splitlines()[-1].startswith("done: ")
    report = read_json(tmp_path / "run/export.json")
    assert report["output"] == str(path)
    assert report["parity"]["voxels"] > 0.999
    assert list(report["outputs"]) == list(OUTPUTS)
    assert report["outputs"]["grid"] == "uint8 [1, 256, 256, 32]"
    assert [*path.parent.iterdir()] == [path]
    names = {str(node.target) for node in torch.export.load(path).graph.nodes}
    assert not [name for name in names if "occdetr" in name]


def test_a_network_that_differs_is_not_kept(varied_checkpoint, tmp_path, monkeypatch, capsys):
    """Nor does it replace the file that is there."""
    path = tmp_path / "network.pt2"
    path.write_bytes(b"before")

    model = export.restore_model(varied_checkpoint)[0]
    queries = model.detector.selection.num_queries
    differing = (
        torch.full((1, 256, 256, 32), 3, dtype=torch.uint8),
        *(torch.zeros(1, queries, size) for size in (4, 6)),
        *(torch.zeros(1, queries) for _ in range(2)),
    )
    stub = Format(
        ".pt2",
        check=lambda: None,
        write=lambda program, names, path: path.write_bytes(b"new"),
        load=lambda path: lambda *_: differing,
    )
    monkeypatch.setitem(export.FORMATS, "torch_export", stub)
    monkeypatch.setattr(export, "trace", lambda network, inputs: None)
    given = ("format=torch_export", f"output={path}")
    assert run(varied_checkpoint, tmp_path / "run", *given) == export.DIFFERS
    assert "of the voxels have equal class, less than 99.9%" in the_error(capsys)
    assert path.read_bytes() == b"before"
    assert read_json(tmp_path / "run/export.json")["output"] is None


def test_a_file_that_cannot_be_written_is_reported_before_the_work(tmp_path, capsys):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", "/proc/nowhere"):
        given = ("format=torch_export", f"output={folder}/network.pt2")
        assert run("any.ckpt", tmp_path / "run", *given) == 2
        assert f"error: output={folder}" in the_error(capsys)


def test_without_its_packages_the_error_names_them(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert run("any.ckpt", tmp_path / "run", "format=onnx") == 2
    assert "pip install 'occdetr[export]'" in the_error(capsys)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("format=torch", "format=torch: choose one of onnx, torch_export, aot_inductor"),
        ("format=null", "format is not set: give it, as in format=onnx"),
        ("output=network.onnx", "network.onnx: give a file name that ends with .pt2"),
        ("score_threshold=1.5", "score_threshold=1.5: give 0 to 1"),
        ("checkpoint=nowhere.ckpt", "nowhere.ckpt: no such file"),
        ("device=abacus", "device=abacus: unknown device"),
        ("repeats=0", "repeats=0: give 1 or more"),
    ],
)
def test_wrong_setting(override, expected, tmp_path, capsys):
    given = ("format=torch_export", override)
    assert run(tmp_path / "any.ckpt", tmp_path / "run", *given) == 2
    assert expected in the_error(capsys)
    assert not [*(tmp_path / "run").glob("[!.]*")]
