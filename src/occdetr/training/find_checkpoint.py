"""Finding earlier runs: what ``init_from=auto`` and ``resume=auto`` start from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from occdetr.errors import InputError
from occdetr.training.renames import migrate
from occdetr.training.trainer import LAST

CONFIG_FILE = "config.yaml"

#: Settings that have to agree for one run's weights to fit another's network.
_SAME_MODEL = (
    *("model_name", "image_size", "strides", "roi_scale"),
    *("attention.hidden_dim", "attention.num_heads", "attention.num_levels"),
    *("attention.num_points", "attention.feedforward_dim"),
    *("model.backbone._target_", "model.backbone.depth"),
    *("model.encoder.in_channels", "model.encoder.num_layers"),
    *("model.detector.num_layers", "query_content"),
)


def newest_run(
    outputs: str | Path, stage: str, config: Mapping[str, Any], same_partition: bool = False
) -> Path | None:
    """The newest ``last.ckpt`` below ``outputs/<stage>`` of a run with ``config``'s model.

    Runs with the same partition are preferred, or with ``same_partition`` required. None if there
    is no such run.
    """
    wanted = _model_of(config)
    found = []
    for checkpoint in Path(outputs).glob(f"{stage}/*/{LAST}.ckpt"):
        saved = _read_config(checkpoint.parent / CONFIG_FILE)
        if saved is None or not _fits(_model_of(saved), wanted):
            continue
        same = saved.get("partition_name") == config["partition_name"]
        if same or not same_partition:
            found.append((same, checkpoint.stat().st_mtime_ns, checkpoint))
    return max(found)[2] if found else None


def check_same_model(
    saved: Mapping[str, Any], config: Mapping[str, Any], setting: str, same_partition: bool = False
) -> None:
    """Raises ``InputError`` if a checkpoint's config has another network than ``config``."""
    theirs, ours = _model_of(saved), _model_of(config)
    keys = _SAME_MODEL
    if same_partition:
        keys = (*keys, "partition_name")
        theirs["partition_name"] = saved.get("partition_name")
        ours["partition_name"] = config["partition_name"]
    for key in keys:
        if not _fits({key: theirs[key]}, {key: ours[key]}):
            raise InputError(
                f"{setting}: it was trained with {key}={theirs[key]}, this run has {ours[key]}: "
                "use the same model settings or another checkpoint"
            )


def _read_config(path: Path) -> dict[str, Any] | None:
    """A run's configuration in today's form; None if it cannot be read."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return None
    return migrate(content) if isinstance(content, dict) else None


def _model_of(config: Mapping[str, Any]) -> dict[str, Any]:
    def select(key: str) -> Any:
        node: Any = config
        for part in key.split("."):
            node = node.get(part) if isinstance(node, Mapping) else None
        return node

    return {key: select(key) for key in _SAME_MODEL}


def _fits(saved: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Equal, but for the parts that one of the two partitions does not have."""
    return all(
        saved[key] == value or (key == "model.detector.num_layers" and None in (saved[key], value))
        for key, value in wanted.items()
    )
