"""Which device computes, and how much memory it has used."""

from __future__ import annotations

import os
import re
import resource
import sys
from pathlib import Path
from typing import Any

import torch

from occdetr.errors import InputError

MIB = 2**20
MAX_CPU_PROCESSES = 64  # or a core each; more are a mistake
#: A number, the numbers of several GPUs (as text or a list), all, or as many as there are.
_DEVICES = re.compile(r"auto|-1|[1-9]\d*|\d+,|\d+(, ?\d+)+|\[\d+(, ?\d+)*\]")


def choose_device(name: str) -> torch.device:
    """``auto`` (a GPU if there is one), ``cpu``, ``cuda`` or ``cuda:1``.

    Raises ``InputError`` for an unknown device and for CUDA without a GPU.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"device={name}: unknown device: use auto, cpu or cuda") from None
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"device={name}: is not supported: use auto, cpu or cuda")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device={name}: no CUDA GPU is visible: use device=cpu")
    count = torch.cuda.device_count() if device.type == "cuda" else 1
    if (device.index or 0) >= count:
        last = f"{device.type}:{count - 1}" if count > 1 else device.type
        raise InputError(f"device={name}: there is no such device: use one up to {last}")
    return device


def check_devices(accelerator: Any, devices: Any) -> None:
    """Raises ``InputError`` unless ``devices`` is a number of devices or a choice of GPUs, and if
    GPUs are asked for where there is none: Lightning would start as many processes on the CPU."""
    if devices is None:
        return
    setting, text = f"trainer.devices={devices}", str(devices)
    if not _DEVICES.fullmatch(text):
        raise InputError(
            f"{setting}: give a number of devices, GPUs as in [0,1], -1 for all, or auto"
        )
    no_gpu = not torch.cuda.is_available()
    if (accelerator == "cpu" or (accelerator == "auto" and no_gpu)) and text != "auto":
        if not text.isdecimal():
            raise InputError(f"{setting}: on the CPU give the number of processes, as in 1")
        most = max(MAX_CPU_PROCESSES, os.cpu_count() or 1)
        if int(text) > most:
            raise InputError(f"{setting}: give {most} processes on the CPU or fewer")
    if accelerator == "auto" and no_gpu and text not in ("1", "auto"):
        raise InputError(
            f"{setting}: no CUDA GPU is visible: give trainer.devices=1, or "
            f"trainer.accelerator=cpu for {devices} processes on the CPU"
        )


def computes_bf16(accelerator: str) -> bool:
    """Whether the device has instructions for matrix products in bf16."""
    if accelerator != "cpu" and torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # newer than torch 2.8
    return any(capabilities.get(name) for name in ("avx512_bf16", "amx_bf16"))


def peak_memory_mb(device: torch.device) -> float:
    """MiB: on a GPU the most that torch's allocator has held, else that this process has had.

    Linux starts the maximum of a new process at that of the one that started it, but not ``VmHWM``.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / MIB
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    for line in lines:
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (MIB if sys.platform == "darwin" else 1024)  # the system counts KiB, macOS bytes
