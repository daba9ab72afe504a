"""One run of a study (an arm with a seed): train, evaluate, measure; returns its record."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from occdetr.cli import entry as cli
from occdetr.cli.overrides import overrides_of
from occdetr.cli.subprocesses import run_entry_point
from occdetr.data.datamodule import SceneDataModule
from occdetr.evaluation import speed
from occdetr.evaluation.position_baseline import score_baseline
from occdetr.streets.datamodule import SyntheticDataModule
from occdetr.streets.writer import GENERATOR_VERSION
from occdetr.study.provenance import code_hash, code_state, file_hash, machine
from occdetr.training.checkpoint import restore_model
from occdetr.training.device import choose_device
from occdetr.training.find_checkpoint import CONFIG_FILE
from occdetr.training.released import find_released
from occdetr.training.run_checkpoint import LAST
from occdetr.training.trainer import seed_everything

DETECTION = ("mAP", "AP50", "recall3d_25")
COMPLETION = ("mIoU", "mIoU_present", "IoU", "precision", "recall", "per_class")


@dataclass(frozen=True)
class StudyRun:
    """One arm of a study with one seed.

    ``overrides`` are passed to every training. ``stages`` are trained one after the other, the
    first from the checkpoint ``start`` if it is given. ``baseline``: nothing is trained, the
    position baseline is scored.
    """

    study: str
    arm: str
    seed: int
    overrides: tuple[str, ...]
    stages: tuple[str, ...]
    start: Path | None
    baseline: bool

    @property
    def name(self) -> str:
        return f"{self.arm}_seed{self.seed}"

    def settings(self) -> DictConfig:
        """The configuration of the last stage. Raises ``InputError`` on an override that is invalid
        in one of the stages."""
        given = [[f"stage={stage}", *self.overrides] for stage in self.stages or ("full",)]
        return [cli.compose_checked("train", overrides) for overrides in given][-1]


def perform(run: StudyRun, folder: Path, latency: Mapping[str, int] | None) -> dict[str, Any]:
    """Train, evaluate and measure a run; returns the record that its JSON file holds.

    ``latency``: ``repeats`` and ``warmup`` of the latency measurement; None skips it.
    """
    settings = run.settings()
    state = code_state(cli.config_dir().parent)  # before training, as the code may change meanwhile
    code = current_code_hash()
    datamodule = cli.build(settings.data)
    datamodule.prepare_data()
    datamodule.prepare_objects(num_workers=1)
    if run.baseline:
        measured = measure_baseline(datamodule)
    else:
        measured = train_and_evaluate(run, settings, folder)
    if latency is not None:
        measured["latency"] = measure_latency(folder / run.stages[-1], settings, latency)
    device = choose_device("cpu" if settings.trainer.accelerator == "cpu" else "auto")
    synthetic = isinstance(datamodule, SyntheticDataModule)
    changed = current_code_hash() != code
    if changed:
        print("note: the code changed during this run: run studies in a separate clone")
    return {
        **{"study": run.study, "arm": run.arm, "seed": run.seed},
        **{**state, "code": code, "code_changed": changed},
        "generator_version": GENERATOR_VERSION if synthetic else None,
        "data": {"train": datamodule.training_summary(), "val": datamodule.summary("val")},
        "machine": machine(device, trained_precision(run, settings, folder)),
        **{"model": settings.model_name, "image_size": list(settings.image_size)},
        **measured,
    }


def trained_precision(run: StudyRun, settings: DictConfig, folder: Path) -> Any:
    """What the first stage has taken for "auto"; without training, what is configured."""
    if not run.stages:
        return settings.trainer.precision
    return OmegaConf.load(folder / run.stages[0] / CONFIG_FILE).trainer.precision


def current_code_hash() -> str:
    """Hash of the package and its configuration as they are on the disk now."""
    return code_hash(Path(__file__).parents[1], cli.config_dir())


def measure_baseline(datamodule: SceneDataModule) -> dict[str, Any]:
    """The scores of the position baseline of the training frames on the held-out frames."""
    start = time.monotonic()
    figures = score_baseline(datamodule.frames("train"), datamodule.frames("val"))
    return {
        "commands": [],
        "start": None,
        "stages": {},
        **{"steps": 0, "seconds": round(time.monotonic() - start, 1), "peak_memory_mb": None},
        "curve": [],
        "figures": {key: figures[key] for key in COMPLETION},
    }


def train_and_evaluate(run: StudyRun, settings: DictConfig, folder: Path) -> dict[str, Any]:
    """Train every stage, then evaluate the last checkpoint on the held-out frames."""
    checkpoint, commands, stages, curve = run.start, [], {}, []
    start = None if run.start is None else start_facts(run.start)  # it may change meanwhile
    keys = figure_names(run, settings)
    for stage in run.stages:
        init_from = [] if checkpoint is None else [f"init_from={checkpoint}"]
        overrides = [f"stage={stage}", *run.overrides, *init_from]
        commands.append(run_entry_point("train", overrides, folder / stage).command)
        summary = json.loads((folder / stage / "metrics.json").read_text())
        first_step = sum(previous["steps"] for previous in stages.values())
        stages[stage] = stage_facts(folder / stage, summary)
        curve += [curve_point(stage, first_step, point, keys) for point in summary["validations"]]
        checkpoint = folder / stage / LAST
    data = [] if run.stages else evaluation_data(run, settings)
    overrides = [f"checkpoint={checkpoint}", *data]
    commands.append(run_entry_point("evaluate", overrides, folder / "evaluate").command)
    metrics = json.loads((folder / "evaluate" / "metrics.json").read_text())
    peaks = [stage["peak_memory_mb"] for stage in stages.values()]
    return {
        "commands": commands,
        "start": start,
        "stages": stages,
        "steps": sum(stage["steps"] for stage in stages.values()),
        "seconds": round(sum(stage["seconds"] for stage in stages.values()), 1),
        "peak_memory_mb": max(peaks, default=None),
        "curve": curve,
        "figures": {key: metrics[key] for key in keys},
    }


def figure_names(run: StudyRun, settings: DictConfig) -> tuple[str, ...]:
    """The scores that apply to the parts that were trained."""
    detection = DETECTION if settings.model.detector is not None else ()
    completion = COMPLETION if run.stages != ("pretrain",) else ()
    return (*detection, *completion)


def stage_facts(folder: Path, summary: Mapping[str, Any]) -> dict[str, Any]:
    """What a record keeps of a training: its length, duration and memory."""
    trained: Any = OmegaConf.load(folder / "config.yaml")
    facts = {key: summary[key] for key in ("epochs", "steps", "seconds", "peak_memory_mb")}
    return {**facts, "batch_size": trained.data.batch_size, "lr": trained.optimizer.lr}


def curve_point(
    stage: str, first_step: int, point: Mapping[str, float], keys: Sequence[str]
) -> dict[str, Any]:
    """A validation of a stage that began at ``first_step``; steps count over all stages."""
    figures = {key: round(point[key], 6) for key in keys if key in point}
    return {"stage": stage, "step": first_step + int(point["step"]), **figures}


def start_facts(checkpoint: Path) -> dict[str, str]:
    """Path and hash of the checkpoint that a run started from."""
    return {"checkpoint": str(checkpoint), "sha256": file_hash(find_released(checkpoint))}


def evaluation_data(run: StudyRun, settings: DictConfig) -> list[str]:
    """Overrides of ``evaluate`` that replace the checkpoint's data by the run's real frames."""
    data_overrides = overrides_of("data", run.overrides)
    return ["data=semantickitti", f"data.root={settings.data.root}", *data_overrides]


def measure_latency(
    folder: Path, settings: DictConfig, latency: Mapping[str, int]
) -> dict[str, Any]:
    """Time a forward pass of the trained network on the first held-out frame, float32."""
    seed_everything(settings.seed)
    device = choose_device("cpu" if settings.trainer.accelerator == "cpu" else "auto")
    model = restore_model(folder / LAST)[0].to(device)
    datamodule = cli.build(settings.data, batch_size=1, num_workers=0)
    datamodule.setup("test")
    batch = next(iter(datamodule.test_dataloader())).to(device)
    repeats, warmup = latency["repeats"], latency["warmup"]
    return speed.measure_latency(
        lambda: model.predict(batch), device, repeats=repeats, warmup=warmup
    )
