"""ImageNet weights: the download is checked by its hash, damaged files are named."""

from __future__ import annotations

import pytest
import torch

from occdetr.errors import InputError
from occdetr.models.backbone import IMAGENET_FILES, ResNet, official_weights


@pytest.fixture
def downloads(tmp_path, monkeypatch):
    """An empty torch.hub cache, and the expected hash prefix of each download."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.delenv("TORCH_MODEL_ZOO", raising=False)
    seen = []

    def download(url, destination, hash_prefix=None, progress=True):
        seen.append(hash_prefix)
        torch.save(ResNet(18, freeze_norm=False).state_dict(), destination)

    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    return seen


def test_a_download_is_checked_by_the_hash_in_its_name(downloads):
    state = official_weights("imagenet", 18)
    assert downloads == ["f37072fd"]
    assert IMAGENET_FILES[18] == "resnet18-f37072fd.pth"
    ResNet(18).load_state_dict(state)


def test_a_wrong_hash_is_a_user_error(downloads, monkeypatch):
    def download(*_, **__):
        raise RuntimeError("invalid hash value")

    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    with pytest.raises(InputError, match=r"resnet18-f37072fd\.pth is damaged"):
        official_weights("imagenet", 18)


def test_a_damaged_file_in_the_cache_is_named(downloads, tmp_path):
    cached = tmp_path / "hub" / "checkpoints" / IMAGENET_FILES[18]
    cached.parent.mkdir(parents=True)
    cached.write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match=r"checkpoints/resnet18-f37072fd\.pth is damaged"):
        official_weights("imagenet", 18)
