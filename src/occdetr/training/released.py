"""Models as they are given to others: one file of weights with their configuration.

The file is in the format of safetensors, whose metadata hold the configuration as JSON. Models that
come with the package are named by their stem alone, as in ``checkpoint=tiny``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import safe_open
from torch import Tensor

import occdetr
from occdetr.files import write_atomically

SUFFIX = ".safetensors"
FOLDER = Path(occdetr.__file__).parent / "released"
#: Settings of the data that follow the network.
NETWORK_SETTINGS = ("image_size", "strides", "roi_scale")

#: ``hash_of`` the weights of files that were written without it.
PUBLISHED = {"tiny.safetensors": "8e2bf83c0192104233d01ca69778fb8c53c1cccb480eb805b48c424a5f59f4f4"}
_METADATA = "occdetr"
_LARGEST = 2**20  # characters of JSON; ours have 20,000
#: Nodes of a run's configuration that are not kept.
_LEFT_OUT = ("outputs", "hydra", "init_from", "resume", "callbacks", "logger", "trainer", "compile")


def released_names() -> list[str]:
    """The models that come with the package."""
    return sorted(file.stem for file in FOLDER.glob(f"*{SUFFIX}"))


def find_released(path: Path) -> Path:
    """The file of a released model: ``path``, unless it is the name of one of the package's and no
    file of this name is there."""
    if path.name == str(path) and path.name in released_names() and not path.is_file():
        return FOLDER / f"{path.name}{SUFFIX}"
    return path


def write_released(
    file: Path, state: Mapping[str, Tensor], config: Mapping[str, Any], **about: str
) -> None:
    """Write a file of weights, of the ``config`` of their run, and of ``about``.

    Matrices and kernels become bf16, which halves the file; vectors, such as norms, stay as they
    are. Of the configuration neither the run nor the data set is kept.
    """
    weights = {
        name: value.to(torch.bfloat16).contiguous()
        if value.is_floating_point() and value.ndim > 1
        else value.clone()
        for name, value in state.items()
    }
    kept = {key: value for key, value in config.items() if key not in _LEFT_OUT}
    kept["data"] = {key: config["data"][key] for key in NETWORK_SETTINGS}
    text = json.dumps({**about, "sha256": hash_of(weights), "config": kept})
    write_atomically(file, safetensors.torch.save(weights, {_METADATA: text}))


def hash_of(state: Mapping[str, Tensor]) -> str:
    """SHA-256 of weights with their names, types and shapes, in hexadecimal digits."""
    found = hashlib.sha256()
    for name in sorted(state):
        value = state[name].contiguous()
        found.update(f"{name} {value.dtype} {tuple(value.shape)} ".encode())
        found.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def read_released(file: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What ``write_released`` has written: ``about`` with the ``config``, and the weights.

    Raises ``ValueError`` if it is not such a file or holds other weights than were written, and
    what safetensors, JSON and PyTorch raise for one that is damaged.
    """
    with safe_open(file, framework="pt") as content:
        text = (content.metadata() or {}).get(_METADATA)
        if text is None or len(text) > _LARGEST:
            raise ValueError("was not written by occdetr.export")
        state = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118
    about = json.loads(text)
    written = about.get("sha256") or (PUBLISHED.get(file.name) if file.parent == FOLDER else None)
    if written not in (None, hash_of(state)):
        raise ValueError("holds other weights than it was written with")
    return about, state
