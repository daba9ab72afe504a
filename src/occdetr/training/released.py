"""Models as they are given to others: weights as safetensors, their configuration as JSON.

``tiny.safetensors`` and ``tiny.json`` belong together. Those that come with the package are named
by their stem alone, as in ``checkpoint=tiny``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

import occdetr
from occdetr.files import replacing, write_json

SUFFIX = ".safetensors"
FOLDER = Path(occdetr.__file__).parent / "released"
#: Nodes of a run's configuration that say nothing of the model.
_OF_RUN = ("outputs", "hydra", "init_from", "resume", "callbacks", "logger", "trainer", "compile")


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
    file: Path, state: Mapping[str, Tensor], config: Mapping[str, Any], **about: Any
) -> None:
    """Write ``file`` and the JSON beside it. ``about`` is kept beside ``config``.

    Matrices and kernels become bf16, which halves the file; vectors, such as norms, stay as they
    are.
    """
    weights = {
        name: value.to(torch.bfloat16).contiguous()
        if value.is_floating_point() and value.ndim > 1
        else value.contiguous()
        for name, value in state.items()
    }
    kept = {key: value for key, value in config.items() if key not in _OF_RUN}
    with replacing(file) as temporary:
        save_file(weights, temporary)
    write_json(file.with_suffix(".json"), {**about, "config": kept})


def read_released(file: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What ``write_released`` has written: the JSON, and the weights.

    Raises ``ValueError`` if one of the files is damaged, and ``OSError`` if it cannot be read.
    """
    about = json.loads(file.with_suffix(".json").read_text())
    try:
        state = load_file(file)
    except SafetensorError as error:
        raise ValueError(str(error)) from error
    return about, state
