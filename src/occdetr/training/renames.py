"""Older checkpoints: their configuration in today's names."""

from __future__ import annotations

import copy
from typing import Any

from occdetr.training.network_renames import migrate_network

#: Classes that have moved.
TARGETS = {
    "occdetr.data.datamodule.SyntheticDataModule": "occdetr.streets.datamodule.SyntheticDataModule",
}


def migrate(config: dict[str, Any]) -> dict[str, Any]:
    """The configuration of a run, whatever version wrote it, as today's code takes it."""
    config = copy.deepcopy(config)
    _move_targets(config)
    migrate_network(config)
    return config


def _move_targets(config: dict[str, Any]) -> None:
    for name, value in config.items():
        if isinstance(value, dict):
            _move_targets(value)
        elif name == "_target_":
            config[name] = TARGETS.get(value, value)
