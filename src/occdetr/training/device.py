"""Which device computes, in which precision, and how much memory it has used."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import Any

import torch

from occdetr.errors import InputError

MIB = 2**20


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
    """Raises ``InputError`` if several GPUs are asked for where there is none.

    Lightning would start as many processes on the CPU.
    """
    several = isinstance(devices, int) and devices > 1
    if accelerator == "auto" and several and not torch.cuda.is_available():
        raise InputError(
            f"trainer.devices={devices}: no CUDA GPU is visible: give trainer.devices=1, or "
            f"trainer.accelerator=cpu for {devices} processes on the CPU"
        )


def computes_bf16(accelerator: str) -> bool:
    """Whether matrix products in bf16 are native here, and so several times faster."""
    if accelerator != "cpu" and torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # newer than torch 2.8
    return any(capabilities.get(name) for name in ("avx512_bf16", "amx_bf16"))


def resolve_precision(precision: Any, accelerator: str) -> Any:
    """``precision``, but for "auto": bf16-mixed where ``accelerator`` (a kind of device, such as
    cpu or cuda, or auto) computes in bf16, else 32-true."""
    if precision != "auto":
        return precision
    return "bf16-mixed" if computes_bf16(accelerator) else "32-true"


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
