"""One arm of a study with one seed: trained, evaluated, measured; all that its file keeps."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from occdetr.benchmark import measure
from occdetr.cli import entry as cli
from occdetr.cli.subprocesses import run_entry
from occdetr.demo import score_baseline
from occdetr.streets.datamodule import SyntheticDataModule
from occdetr.streets.writer import GENERATOR_VERSION
from occdetr.study.provenance import code_hash, code_state, file_hash, machine
from occdetr.training.checkpoint import restore_model
from occdetr.training.device import choose_device, resolve_precision
from occdetr.training.trainer import LAST, seed_everything

DETECTION = ("mAP", "AP50", "recall3d_25")
COMPLETION = ("mIoU", "mIoU_present", "IoU", "precision", "recall", "per_class")


@dataclass(frozen=True)
class StudyRun:
    """One arm of a study with one seed.

    ``overrides`` are those of all its trainings. ``stages`` are trained one after the other, the
    first from the checkpoint ``start`` if there is one.
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
        """The configuration of its last stage. Raises ``InputError`` on a wrong override."""
        stage = self.stages[-1] if self.stages else "full"
        return cli.compose_checked("train", [f"stage={stage}", *self.overrides])


def perform(run: StudyRun, folder: Path, latency: Mapping[str, int] | None) -> dict[str, Any]:
    """Train, evaluate and measure; all that the run's file keeps."""
    settings = run.settings()
    state = code_state(cli.config_dir().parent)  # before training, which may outlast it
    code = current_code()
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
    changed = current_code() != code
    if changed:
        print("note: the code changed meanwhile; run studies in a clone that nobody works in")
    return {
        **{"study": run.study, "arm": run.arm, "seed": run.seed},
        **{**state, "code": code, "code_changed": changed},
        "generator_version": GENERATOR_VERSION if synthetic else None,
        "data": {split: datamodule.summary(split) for split in ("train", "val")},
        "machine": machine(device, resolve_precision(settings.trainer.precision, device.type)),
        **{"model": settings.model_name, "image_size": list(settings.image_size)},
        **measured,
    }


def current_code() -> str:
    """Stands for the program and its configuration as they lie on the disk."""
    return code_hash(Path(__file__).parents[1], cli.config_dir())


def measure_baseline(datamodule: Any) -> dict[str, Any]:
    """The position baseline of the training frames, on the held-out ones."""
    began = time.monotonic()
    figures = score_baseline(datamodule.frames("train"), datamodule.frames("val"))
    return {
        "commands": [],
        "start": None,
        "stages": {},
        **{"steps": 0, "seconds": round(time.monotonic() - began, 1), "peak_memory_mb": None},
        "curve": [],
        "figures": {key: figures[key] for key in COMPLETION},
    }


def train_and_evaluate(run: StudyRun, settings: DictConfig, folder: Path) -> dict[str, Any]:
    """Every stage, then the last checkpoint on the held-out frames."""
    checkpoint, commands, stages, curve = run.start, [], {}, []
    keys = figure_names(run, settings)
    for stage in run.stages:
        begin = [] if checkpoint is None else [f"init_from={checkpoint}"]
        done = run_entry("train", [f"stage={stage}", *run.overrides, *begin], folder / stage)
        commands.append(done.line)
        summary = json.loads((folder / stage / "metrics.json").read_text())
        before = sum(each["steps"] for each in stages.values())
        stages[stage] = stage_facts(folder / stage, summary)
        curve += [curve_point(stage, before, point, keys) for point in summary["validations"]]
        checkpoint = folder / stage / f"{LAST}.ckpt"
    data = [] if run.stages else other_data(run, settings)
    done = run_entry("evaluate", [f"checkpoint={checkpoint}", *data], folder / "evaluate")
    metrics = json.loads((folder / "evaluate" / "metrics.json").read_text())
    peaks = [stage["peak_memory_mb"] for stage in stages.values()]
    return {
        "commands": [*commands, done.line],
        "start": None if run.start is None else start_facts(run.start),
        "stages": stages,
        "steps": sum(stage["steps"] for stage in stages.values()),
        "seconds": round(sum(stage["seconds"] for stage in stages.values()), 1),
        "peak_memory_mb": max(peaks, default=None),
        "curve": curve,
        "figures": {key: metrics[key] for key in keys},
    }


def figure_names(run: StudyRun, settings: DictConfig) -> tuple[str, ...]:
    """The figures that mean something for what was trained."""
    detection = DETECTION if settings.model.detector is not None else ()
    completion = COMPLETION if run.stages != ("pretrain",) else ()
    return (*detection, *completion)


def stage_facts(folder: Path, summary: Mapping[str, Any]) -> dict[str, Any]:
    """What a record says of a training: its size, pace and memory."""
    trained: Any = OmegaConf.load(folder / "config.yaml")
    facts = {key: summary[key] for key in ("epochs", "steps", "seconds", "peak_memory_mb")}
    return {**facts, "batch_size": trained.data.batch_size, "lr": trained.optimizer.lr}


def curve_point(
    stage: str, before: int, point: Mapping[str, float], keys: Sequence[str]
) -> dict[str, Any]:
    """A validation, its step counted from the first step of the first stage."""
    figures = {key: round(point[key], 6) for key in keys if key in point}
    return {"stage": stage, "step": before + int(point["step"]), **figures}


def start_facts(checkpoint: Path) -> dict[str, str]:
    """Which checkpoint a run began with."""
    return {"checkpoint": str(checkpoint), "sha256": file_hash(checkpoint)}


def other_data(run: StudyRun, settings: DictConfig) -> list[str]:
    """What tells ``evaluate`` to take the run's real frames instead of the checkpoint's streets."""
    of_data = [text for text in run.overrides if text.startswith("data.")]
    return ["data=semantickitti", f"data.root={settings.data.root}", *of_data]


def measure_latency(
    folder: Path, settings: DictConfig, repeats: Mapping[str, int]
) -> dict[str, Any]:
    """A forward pass of the trained network on the first held-out frame: batch 1, float32."""
    seed_everything(settings.seed)
    device = choose_device("cpu" if settings.trainer.accelerator == "cpu" else "auto")
    model = restore_model(folder / f"{LAST}.ckpt")[0].to(device)
    datamodule = cli.build(settings.data, batch_size=1, num_workers=0)
    datamodule.setup("test")
    batch = next(iter(datamodule.test_dataloader())).to(device)
    times = OmegaConf.create(dict(repeats))
    measured = measure(lambda: model.predict(batch), times, device, "forward")
    del measured["peak_memory_mb"]  # this process has done other things
    return measured
