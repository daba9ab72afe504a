"""Full disks, missing memory and killed processes as one line."""

import errno
import os
from pathlib import Path

import pytest
import torch
from hydra.errors import InstantiationException
from omegaconf import OmegaConf

from occdetr.cli.system_errors import explain_system
from occdetr.cli.user_errors import explain
from occdetr.errors import InputError
from occdetr.files import write_atomically
from occdetr.training.device import check_devices, choose_device


@pytest.mark.parametrize(
    "name", ["ENOSPC", "EDQUOT", "EROFS", "EACCES", "ENAMETOOLONG", "ENOTDIR", "EEXIST", "EIO"]
)
def test_an_error_of_a_file_names_it(name):
    number = getattr(errno, name)
    line = explain_system(OSError(number, os.strerror(number), "/some/file"))
    assert line.startswith(f"/some/file: {os.strerror(number).lower()}")
    worker = (
        f"Caught OSError in DataLoader worker process 0.\n  File\nOSError: [Errno {number}] x: '/a'"
    )
    assert explain_system(OSError(worker)).startswith("/a: ")
    wrapper = RuntimeError("a wrapper")
    wrapper.__cause__ = OSError(number, "x", "/some/file")
    assert explain_system(wrapper) == line


def test_a_full_disk_is_named_and_the_old_file_stays(tmp_path, monkeypatch):
    write_atomically(tmp_path / "a", b"old")

    def full(self, data):
        with open("/dev/full", "wb", buffering=0) as file:
            file.write(data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left") as error:
        write_atomically(tmp_path / "a", b"new")
    line = explain_system(error.value)
    assert line.startswith(f"{tmp_path}/a: no space left on device (disk /")
    assert [file.name for file in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_bytes() == b"old"


def test_a_checkpoint_on_a_full_disk():
    with pytest.raises((OSError, RuntimeError)) as error:
        torch.save({"a": torch.zeros(10**6)}, "/dev/full")
    assert "free some space, or choose a folder on another disk" in explain_system(error.value)


@pytest.mark.parametrize(
    ("error", "fact"),
    [
        (MemoryError(), "out of memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), "out of memory"),
        (RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed. "), "was killed"),
        (RuntimeError("DataLoader worker (pid(s) 7) exited unexpectedly"), "was killed"),
    ],
)
def test_missing_memory(error, fact):
    assert fact in explain_system(error)


def test_a_defect_is_not_explained():
    for error in (RuntimeError("a defect"), OSError("a defect"), KeyError("a")):
        assert explain_system(error) is None


@pytest.mark.parametrize("name", ["mps", "meta", "xpu", "cuda:7", "cuda", "abacus", "cpu:3", ""])
def test_a_device_that_does_not_exist(name, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: name == "cuda:7")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(InputError, match=f"device={name}: "):
        choose_device(name)


def test_several_gpus_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match=r"trainer\.devices=3: no CUDA GPU"):
        check_devices("auto", 3)
    right = (("cpu", 3), ("auto", 1), ("auto", "auto"), ("auto", None), ("gpu", -1))
    more = (("cpu", "2"), ("gpu", [0, 1]), ("gpu", "0,1"), ("gpu", "1,"), ("cuda", 8))
    for accelerator, devices in (*right, *more):
        check_devices(accelerator, devices)


@pytest.mark.parametrize("devices", [-1, 0, "0", 10**9, 1.5, "two", [1], "0,1", [], True])
def test_devices_that_the_cpu_has_not(devices):
    with pytest.raises(InputError, match=r"^trainer\.devices=.*: .*give "):
        check_devices("cpu", devices)


def test_a_part_that_does_not_fit_into_the_memory():
    error = InstantiationException("Error in call\nfull_key: model.encoder")
    error.__cause__ = RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried")
    line = explain(error, [], Path(), lambda given: OmegaConf.create())
    assert line is not None
    assert line.startswith("model.encoder: out of memory: ")
