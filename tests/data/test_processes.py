"""Cores and shared memory that this process may use."""

import os
from types import SimpleNamespace

import pytest

from occdetr.data import processes
from occdetr.data.datamodule import SceneDataModule
from occdetr.errors import InputError


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 8),
        ({"cpu.max": "max 100000\n"}, 8),
        ({"cpu.max": "150000 100000\n"}, 2),
        ({"cpu.max": "1000 100000\n"}, 1),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
    ],
)
def test_cores_are_those_of_affinity_and_quota(files, cores, tmp_path, monkeypatch):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(processes, "CGROUP", tmp_path)
    monkeypatch.setattr(processes, "CORES", set(range(8)))
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    assert processes.available_cores() == cores


def test_workers_need_shared_memory(streets, monkeypatch):
    def loader(workers):
        data = SceneDataModule(root=streets, image_size=(64, 208), num_workers=workers)
        return data.val_dataloader()

    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=1024, f_frsize=4096))
    loader(0)
    with pytest.raises(InputError, match=r"data.num_workers=2: .* 4 free: set data.num_workers=0"):
        loader(2)
