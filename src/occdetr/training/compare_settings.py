"""Which settings two runs must share, for one to continue the other or to start from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

from occdetr.errors import InputError

Difference = tuple[str, Any, Any]

#: Settings without a part in what is learnt: where and how a run runs.
PLACE = (
    *("resume", "init_from", "outputs", "logger*", "callbacks*", "model.backbone.weights"),
    *(
        "data.root",
        "data.extra_roots",
        "data.cache_dir",
        "data.num_workers",
        "data.pin_memory",
        "data.write_workers",
    ),
    *("compile", "data.eval_split", "data.exchange_images", "data.allow_partial"),
    *("trainer.accelerator", "trainer.devices", "trainer.num_nodes", "trainer.strategy"),
    *("trainer.enable_*", "trainer.log_every_n_steps", "trainer.profiler", "trainer.logger*"),
    *("trainer.callbacks*", "trainer.num_sanity_val_steps", "trainer.fast_dev_run"),
    *("trainer.detect_anomaly", "trainer.limit_test_batches"),
    # taken by model.encoder.in_channels and optimizer, which are compared
    *("backbone_channels.*", "backbone_rates.*", "backbone_by_adamw"),
)
#: Settings that may change when a run is resumed; it says so.
CHANGEABLE = (
    *("trainer.*", "optimizer.*", "scheduler.*", "loss.*", "epochs.*", "batch.*"),
    *("module.optimizer.*", "module.scheduler.*", "module.*_criterion.*", "module.freeze_*"),
    "callbacks.*",
    *(
        "data.batch_size",
        "data.flip",
        "data.photometric",
        "data.sensor",
        "data.scale",
        "check_every.*",
    ),
)
#: What a training that was given "auto" has taken is in its configuration.
PRECISION = "trainer.precision"
#: Callbacks that change the weights have to stay.
AVERAGING = "*WeightAveraging"
TARGET = "_target_"

#: Settings that have to agree for one run's weights to fit another's network.
SAME_MODEL = (
    *("model_name", "image_size", "strides", "roi_scale"),
    *("attention.hidden_dim", "attention.num_heads", "attention.num_levels"),
    *("attention.num_points", "attention.feedforward_dim"),
    *("model.backbone._target_", "model.backbone.depth", "model.backbone.variant"),
    *("model.encoder.in_channels", "model.encoder.num_layers", "model.encoder.finest_every"),
    *("model.detector.num_layers", "query_content", "foreground_classes"),
)
#: Settings of a pretraining, besides network and data, that a full training has too.
OF_PRETRAINING = (
    *("partition_name", "foreground_classes", "mask_classes", "early_matching_share"),
    "model.backbone.freeze_norm",
)


def differences(saved: Mapping[str, Any], config: Mapping[str, Any]) -> list[Difference]:
    """Every setting with two values, by its path: (path, value in ``saved``, in ``config``).

    A setting that one of both lacks is None there. ``PLACE`` is left out, but for the settings of
    an average of the weights, and a precision that ``config`` leaves to the run (auto).
    """
    old, new = _leaves(saved), _leaves(config)
    if new.get(PRECISION) == "auto":
        new[PRECISION] = old.get(PRECISION)
    averages = tuple(node for node, _ in [*_averages(old), *_averages(new)])
    paths = [
        path
        for path in dict.fromkeys([*old, *new])
        if not _matches(path, PLACE) or _is_argument(path, averages)
    ]
    return [
        (path, old.get(path), new.get(path)) for path in paths if old.get(path) != new.get(path)
    ]


def fixed_differences(saved: Mapping[str, Any], config: Mapping[str, Any]) -> list[Difference]:
    """Those of the differences with which ``config`` cannot continue a run of ``saved``.

    Network, partition, seed, data, and the kinds of optimizer, schedule and losses.
    """
    found = [each for each in differences(saved, config) if _is_fixed(*each)]
    old, new = (
        next((target for _, target in _averages(_leaves(each))), None) for each in (saved, config)
    )
    return [*found, ("callbacks", old, new)] if old != new else found


def changes(saved: Mapping[str, Any], config: Mapping[str, Any]) -> list[Difference]:
    """Those of the differences that a resumed run takes over, each setting once.

    Nodes refer to others (``module.optimizer`` to ``optimizer``), so most are there twice.
    """
    found = {}
    for path, old, new in differences(saved, config):
        key = (path.rpartition(".")[2], str(old), str(new))
        if not _is_fixed(path, old, new) and len(path) < len(found.get(key, (path + " ",))[0]):
            found[key] = (path, old, new)
    return list(found.values())


def of_data(difference: Difference) -> bool:
    """Whether a difference decides which samples a run sees."""
    path = difference[0]
    return path == "seed" or (path.startswith("data.") and not _matches(path, CHANGEABLE))


def source_differences(saved: Mapping[str, Any], config: Mapping[str, Any]) -> list[Difference]:
    """Why weights of ``saved`` are not the ones that a run of ``config`` means to start from:
    differences in network, partition, query selection, seed or data."""
    others = [
        each for each in differences(saved, config) if of_data(each) or each[0] in OF_PRETRAINING
    ]
    for path, absent in (("data.root", None), ("data.extra_roots", [])):
        roots = select(saved, path) or absent, select(config, path) or absent
        others += [(path, *roots)] if roots[0] != roots[1] else []
    found = {path: (path, old, new) for path, old, new in model_differences(saved, config)}
    return list(({each[0]: each for each in others} | found).values())


def check_same_model(saved: Mapping[str, Any], config: Mapping[str, Any], setting: str) -> None:
    """Raises ``InputError`` if a checkpoint's config has another network than ``config``.

    The image's size may differ: no weight depends on it.
    """
    for key, old, new in model_differences(saved, config):
        if key == "image_size":
            continue
        raise InputError(
            f"{setting}: it was trained with {key}={old}, this run has {new}: "
            "use the same model settings or another checkpoint"
        )


def model_differences(saved: Mapping[str, Any], config: Mapping[str, Any]) -> list[Difference]:
    """Those of ``SAME_MODEL``, but for parts that one of the two partitions does not have."""
    pairs = [(key, select(saved, key), select(config, key)) for key in SAME_MODEL]
    optional = ("model.detector.num_layers", "foreground_classes")
    return [
        (key, old, new)
        for key, old, new in pairs
        if old != new and (key not in optional or (old and new))
    ]


def select(config: Mapping[str, Any], path: str) -> Any:
    """The value at a path such as ``model.backbone.depth``; None if there is none."""
    node: Any = config
    for part in path.split("."):
        node = node.get(part) if isinstance(node, Mapping) else None
    return node


def listed(found: Iterable[Difference]) -> str:
    """Differences in one line."""
    return ", ".join(f"{path} {old} -> {new}" for path, old, new in found)


def _is_fixed(path: str, old: Any, new: Any) -> bool:
    if path.endswith(f".{TARGET}"):
        return True
    if path.endswith("matrix_lr"):  # with it Muon, without it AdamW
        return (old is None) != (new is None)
    if path.endswith("adamw_parts"):  # absent, as in older runs, is none
        return list(old or []) != list(new or [])
    return path.endswith("largest_matrix") or not _matches(path, CHANGEABLE)


def _averages(leaves: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The callbacks that average weights: (path with a dot at its end, class)."""
    return [
        (path.removesuffix(TARGET), str(value))
        for path, value in leaves.items()
        if "callbacks" in path
        and path.endswith(f".{TARGET}")
        and fnmatchcase(str(value), AVERAGING)
    ]


def _is_argument(path: str, nodes: tuple[str, ...]) -> bool:
    return path.startswith(nodes) and not path.endswith(f".{TARGET}")


def _matches(path: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(path, pattern) for pattern in patterns)


def _leaves(node: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(node, Mapping):
        return {prefix: list(node) if isinstance(node, tuple) else node}
    found: dict[str, Any] = {}
    for key, value in node.items():
        found |= _leaves(value, f"{prefix}.{key}" if prefix else str(key))
    return found
