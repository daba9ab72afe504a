"""Types and ranges of the settings.

The settings of the entry points are fields of ``Settings``. A node with a ``_target_`` takes its
types from the constructor's annotations, so that no type is written down twice, and its ranges are
checked by the constructor. Neither is in the defaults lists of ``conf``, because a structured node
is closed: a keyword of the Trainer, or of another class by ``_target_``, could not be added with
``+``.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Optional, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from occdetr.classes import check_classes
from occdetr.cli.hints import accepts, advice
from occdetr.errors import (
    BATCH,
    COUNT,
    NOT_NEGATIVE,
    PROCESSES,
    SEED,
    SHARE,
    InputError,
    Range,
    check_range,
)
from occdetr.geometry.camera import MAX_IMAGE_SIDE, check_image_size
from occdetr.geometry.kitti import FIELD_OF_VIEW


@dataclass
class Settings:
    """The settings of all entry points outside of nodes with a ``_target_``."""

    seed: int
    outputs: str
    folder: str
    results: str
    init_from: str
    resume: str | None
    checkpoint: str | None
    released: str
    start: str | None
    allow: list[str]
    monitor: str
    epochs: dict[str, int]
    batch: dict[str, int]
    check_every: dict[str, int]
    strides: list[int]
    roi_scale: float
    foreground_classes: list[int]
    mask_classes: list[int]
    early_matching_share: float
    overrides: list[str]
    upper_bound: bool
    diagnose: bool
    save_predictions: bool
    pictures: int
    exchange_images: bool
    rebuild: bool
    check: bool
    check_whole: int
    scaling: dict[str, list[float]]
    runs: dict[str, list[str]] | str
    metric: str | None
    curves: int
    streets: int
    compile: bool
    photograph: bool
    split: str
    device: str
    batch_size: int
    threads: int
    workers: int
    worlds: int
    width: int
    sheet: int
    sheet_width: int
    repeats: int
    warmup: int
    samples: int
    picture_frame: int
    horizontal_fov: float | None
    score_threshold: float | None
    backbone_rates: dict[str, float]
    merge_doubles: float | None
    files: list[str] | None
    video: str | None
    fps: float | None
    frame_step: int
    camera: dict[str, float | None]
    viewer: str | None
    submission: str | None


#: Nodes that every command which has them needs.
NODES = ("model", "module", "data", "scene", "trainer")
#: Ranges of those that no constructor checks, or only after hours.
RANGES = {
    **{"worlds": Range(1, 200_000), "samples": COUNT, "repeats": COUNT, "streets": COUNT},
    **{"curves": Range(1, 100)},
    **dict.fromkeys(("sheet", "warmup", "picture_frame", "check_whole"), NOT_NEGATIVE),
    **{"batch_size": BATCH, "threads": Range(1, 1024), "workers": PROCESSES},
    **{"sheet_width": Range(1, MAX_IMAGE_SIDE), "width": Range(320, MAX_IMAGE_SIDE)},
    **{
        "seed": SEED,
        "fps": Range(0.1, 240),
        "frame_step": COUNT,
        "score_threshold": SHARE,
        "merge_doubles": SHARE,
        "early_matching_share": SHARE,
        "horizontal_fov": FIELD_OF_VIEW,
    },
}


def check_types(config: DictConfig) -> None:
    """Raises ``InputError`` for a setting of another type than ``Settings`` or the constructor of
    its node has, and for one of ``RANGES`` outside of its range. Other settings may be anything."""
    for key in NODES:
        if key in config and config[key] is None:
            raise InputError(f"{key}=null: give a node with _target_, or leave it out")
    if _is_given(config, "image_size"):
        _check_size(config.image_size)
    _check(config, config, get_type_hints(Settings))
    for node in _targets(config):
        _check(config, node, _hints(node["_target_"]))
    for key, limits in RANGES.items():
        if _is_given(config, key):
            check_range(key, config[key], limits)
    for key in ("foreground_classes", "mask_classes"):
        if _is_given(config, key):
            check_classes(key, config[key])


def _check_size(size: Any) -> None:
    size = OmegaConf.to_container(size) if OmegaConf.is_config(size) else size
    if not accepts(list[int], size):
        raise InputError(f"image_size={_typed(size)}: must be [height, width] in pixels")
    check_image_size("image_size", size)


def _is_given(node: DictConfig, key: str) -> bool:
    return key in node and not OmegaConf.is_missing(node, key)


def _check(config: DictConfig, node: DictConfig, hints: Mapping[str, Any]) -> None:
    """Raises ``InputError`` for a setting of a node that does not fit its annotation.

    An interpolation that refers to nothing, as in ``evaluate``, is left to the command.
    """
    for key, hint in hints.items():
        if not _is_given(node, key):
            continue
        with contextlib.suppress(InterpolationResolutionError):
            value = node[key]
            if OmegaConf.is_config(value):
                value = OmegaConf.to_container(value, resolve=True)
            if not accepts(hint, value):
                raise InputError(_refusal(_source(config, node, key), hint, value))


def _refusal(setting: str, hint: Any, value: Any) -> str:
    """The error's line; of a dictionary, for the first value that does not fit."""
    if isinstance(value, dict) and get_origin(hint) in (dict, Mapping):
        kind = get_args(hint)[1]
        name = next(name for name, each in value.items() if not accepts(kind, each))
        return _refusal(f"{setting}.{name}", kind, value[name])
    return f"{setting}={_typed(value)}: {advice(hint)}"


def _typed(value: Any) -> str:
    """A value as the user types it; in quotes if it is text that looks like something else."""
    if isinstance(value, str) and not value[:1].isalpha():
        return repr(value)
    return {"None": "null", "True": "true", "False": "false"}.get(str(value), str(value))


def _source(config: DictConfig, node: DictConfig, key: str) -> str:
    """The setting that the user types: that which this one refers to as in ``${image_size}``."""
    raw: Any = OmegaConf.to_container(node, resolve=False)
    reference = re.fullmatch(r"\$\{([\w.]+)\}", str(raw[key]))
    if reference is None:
        return str(node._get_full_key(key))
    parent, _, leaf = reference[1].rpartition(".")
    holder = OmegaConf.select(config, parent) if parent else config
    return _source(config, holder, leaf)


def _targets(node: DictConfig, top: bool = True) -> Iterator[DictConfig]:
    """All nodes that describe an object, where they stand first."""
    if not top and isinstance(node.get("_target_"), str):
        yield node
    for key in map(str, node):
        if OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key):
            continue
        if isinstance(node[key], DictConfig):
            yield from _targets(node[key], top=False)


@functools.cache
def _hints(target: str) -> dict[str, Any]:
    """The annotations of a constructor's keywords; a data module declares some in ``parts``.

    What cannot be imported has none: instantiating it reports that.
    """
    found: dict[str, Any] = {}
    try:
        constructor = get_object(target)
        for part in (constructor, *getattr(constructor, "parts", ())):
            plain = inspect.isclass(part) and "__dataclass_fields__" not in vars(part)
            hints = get_type_hints(part.__init__ if plain else part)
            found |= {name: hints.get(name, Any) for name in inspect.signature(part).parameters}
    except Exception:
        return {}
    if target == "lightning.Trainer":
        found["precision"] |= Literal["auto"]  # see make_trainer
    elif not target.startswith("occdetr."):  # null may stand for the run's folder, see train
        found = {name: Optional[hint] for name, hint in found.items()}  # noqa: UP045
    return found
