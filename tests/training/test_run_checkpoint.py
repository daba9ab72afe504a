"""The files of a run's checkpoints."""

import pytest
import torch

from occdetr.errors import InputError
from occdetr.training import run_checkpoint
from occdetr.training.run_checkpoint import AtomicCheckpointIO, LastCheckpoint, keep_as


def test_the_checkpoint_before_the_last_stays(tmp_path):
    for number in range(3):
        AtomicCheckpointIO().save_checkpoint({"number": number}, tmp_path / "last.ckpt")
    assert torch.load(tmp_path / "last.ckpt") == {"number": 2}
    assert torch.load(tmp_path / "last-previous.ckpt") == {"number": 1}
    assert len(list(tmp_path.iterdir())) == 2


def test_a_checkpoint_that_cannot_be_written_leaves_both_others(tmp_path, monkeypatch):
    for number in range(2):
        AtomicCheckpointIO().save_checkpoint({"number": number}, tmp_path / "last.ckpt")

    def full_disk(content, file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_checkpoint.torch, "save", full_disk)
    with pytest.raises(OSError, match="No space"):
        AtomicCheckpointIO().save_checkpoint({"number": 2}, tmp_path / "last.ckpt")
    assert torch.load(tmp_path / "last.ckpt") == {"number": 1}
    assert torch.load(tmp_path / "last-previous.ckpt") == {"number": 0}
    assert len(list(tmp_path.iterdir())) == 2


def test_a_second_name_works_without_hard_links(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(run_checkpoint.os, "link", refuse)
    (tmp_path / "a").write_bytes(b"content")
    keep_as(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"content"


@pytest.mark.parametrize("setting", ["every_minutes", "every_steps"])
def test_intervals_are_positive(setting, tmp_path):
    with pytest.raises(InputError, match=f"callbacks.checkpoint.{setting}=0"):
        LastCheckpoint(tmp_path, **{setting: 0})
