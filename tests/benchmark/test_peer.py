"""The comparison with a peer, here with a stand-in for it."""

import sys

import pytest
import torch
from torch import nn

from occdetr.benchmark import peer
from programs import SMALL, program, read_json, the_error


class StandIn(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Conv2d(3, 8, 3, stride=2)

    def forward(self, images):
        return torch.relu(self.layer(images))


@pytest.mark.slow
def test_the_networks_beside_the_peer(tmp_path, monkeypatch):
    monkeypatch.setattr(peer, "Peer", StandIn)
    monkeypatch.setattr(peer, "_memory_alone", lambda config, name, batch: (100.0, 150.0))
    monkeypatch.setattr(peer.importlib.metadata, "version", lambda name: "0")
    monkeypatch.setattr(torch, "compile", lambda function, **_: function)
    given = ("vs=transformers", "compile=true", "device=cpu", "repeats=2", "warmup=1")
    assert (
        program("benchmark", *SMALL, "image_size=[96,208]", *given, f"hydra.run.dir={tmp_path}")
        == 0
    )
    report = read_json(tmp_path / "benchmark.json")
    rows = report["networks"]
    assert list(rows) == ["peer", "ours", "our detector", "ours, compiled"]
    assert rows["peer"]["times_the_peer"] == 1
    assert rows["peer"]["params"] == 8 * 28
    assert rows["peer"]["macs"] == 8 * 27 * 47 * 103
    assert rows["ours"]["macs"] > rows["our detector"]["macs"] > 1e8
    assert rows["ours"]["params"] > rows["our detector"]["params"]
    assert rows["ours"]["tensor_memory_mb"] >= rows["our detector"]["tensor_memory_mb"]
    assert "peak MiB" in (tmp_path / "benchmark.md").read_text()


def test_without_the_package_the_error_names_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "transformers", None)
    assert program("benchmark", "vs=transformers", f"hydra.run.dir={tmp_path}") == 2
    assert "vs=transformers" in (line := the_error(capsys))
    assert "pip install 'occdetr[benchmark]'" in line


@pytest.mark.slow
def test_the_peer_itself():
    pytest.importorskip("transformers")
    network = peer.Peer().eval()
    with torch.no_grad():
        output = network(torch.randn(1, 3, 96, 208))
    assert output.pred_boxes.shape == (1, 300, 4)
    assert 40e6 < sum(parameter.numel() for parameter in network.parameters()) < 42e6
