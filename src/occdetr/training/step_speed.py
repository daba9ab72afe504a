"""Where the time of a training step goes: measured in Lightning's own loop."""

from __future__ import annotations

import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.profilers import Profiler

from occdetr.data.datamodule import SceneDataModule
from occdetr.data.dataset import collate
from occdetr.evaluation.parts import (
    REST,
    Cost,
    CostMeter,
    difference,
    parts_of,
    tensor_bytes,
    watched,
)
from occdetr.evaluation.speed import synchronized_time
from occdetr.structures import SceneBatch
from occdetr.training.optimizer import make_optimizer
from occdetr.training.stage import StageModule
from occdetr.training.trainer import make_trainer, run

STEP, LOADING, FORWARD = "step", "waiting for the loader", "forward"
#: The phases of a step, in order, and Lightning's names for them; those of the network's parts are
#: added to the forward pass.
PHASES = {
    "train_dataloader_next": LOADING,
    "batch_to_device": "copy to the device",
    "forward": FORWARD,
    "training_step": "losses",
    "backward": "backward",
    "configure_gradient_clipping": "clipping",
    "optimizer_step": "optimizer",
}


class StepProfiler(Profiler):
    """The seconds of every step by action, without what ran inside of an action under another name.

    ``steps`` has an entry for each step but the first; ``STEP`` is the time from the end of the
    step before to its end. ``cpu_seconds`` is the CPU time of these steps.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self.steps: list[dict[str, float]] = []
        self._device = device
        self._current: Counter[str] = Counter()
        self._open: list[tuple[float, float]] = []  # start, and seconds of the actions inside
        self._ended: float | None = None
        self._cpu_began = 0.0
        self.cpu_seconds = 0.0

    def start(self, action_name: str) -> None:
        self._open.append((synchronized_time(self._device), 0.0))

    def stop(self, action_name: str) -> None:
        now = synchronized_time(self._device)
        began, inside = self._open.pop()
        if self._open:
            outer, others = self._open[-1]
            self._open[-1] = (outer, others + now - began)
        self._current[action_name.rpartition(".")[2]] += now - began - inside  # pyright: ignore
        if action_name == "run_training_batch":
            if self._ended is None:
                self._cpu_began = time.process_time()
            else:
                self.steps.append({**self._current, STEP: now - self._ended})
                self.cpu_seconds = time.process_time() - self._cpu_began
            self._ended, self._current = now, Counter()

    def summary(self) -> str:
        return ""


def time_steps(
    module: StageModule,
    datamodule: SceneDataModule,
    trainer: partial[lightning.Trainer],
    device: torch.device,
    folder: Path,
    steps: int,
) -> tuple[list[dict[str, float]], float]:
    """Train and return the seconds of ``steps`` steps: of each phase and part, and of the ``STEP``;
    and their CPU time / wall time, without that of the loader's workers.

    Nothing is validated, logged or saved.
    """
    profiler = StepProfiler(device)
    keywords: dict[str, Any] = {
        **trainer.keywords,
        "max_epochs": -1,
        "max_steps": steps + 1,
        "limit_val_batches": 0,
        "logger": False,
        "enable_progress_bar": False,
        "profiler": profiler,
    }
    made = make_trainer(partial(trainer.func, **keywords), folder)
    names = parts_of(module.model)
    with watched(names, profiler.start, lambda name, _values: profiler.stop(name)):
        run(made, made.fit, module, datamodule)
    module.trainer = None  # it would refuse to log outside of its loop
    wall = sum(step[STEP] for step in profiler.steps)
    return [_phases(step, list(names)) for step in profiler.steps], profiler.cpu_seconds / wall


def _phases(step: dict[str, float], parts: list[str]) -> dict[str, float]:
    """The phases, the rest and the step, which is their sum; then the parts of the network."""
    forward = {name: step[name] for name in parts if name in step}
    found = {name: step.get(action, 0.0) for action, name in PHASES.items()}
    found[FORWARD] = sum(forward.values())
    rest = step[STEP] - sum(found.values())
    return {**found, REST: rest, STEP: step[STEP], **forward}


def count_step(module: StageModule, batch: SceneBatch, clip: float | None) -> dict[str, Cost]:
    """The cost of each phase of a step on ``batch``, which changes the weights.

    ``least_bytes`` (``Cost``) of the forward pass is the sum over the parts. Of the backward pass
    it is the same, with gradients in place of outputs, and the parameters' gradients. The losses
    have none. Clipping reads the gradients, the optimizer reads them, and reads and writes the
    parameters and its own state.
    """
    module.train()
    model = module.model
    optimizer = make_optimizer(model, module.optimizer_settings)
    with CostMeter(parts_of(model)) as meter:
        start = meter.total()
        loss = module.training_step(batch, 0)
        assert isinstance(loss, torch.Tensor)
        middle = meter.total()
        loss.backward()
        back = meter.total()
        trained = [p for p in model.parameters() if p.grad is not None]
        if clip:
            torch.nn.utils.clip_grad_norm_(trained, clip)
        clipped = meter.total()
        optimizer.step()
        end = meter.total()
    forward = [sum(values) for values in zip(*map(_fields, meter.parts.values()), strict=True)]
    both, weights = difference(middle, start), tensor_bytes(trained)
    states = tensor_bytes([list(state.values()) for state in optimizer.state.values()])
    phases = {
        FORWARD: Cost(*forward),
        "losses": Cost(both.macs - forward[0], 0, both.operator_bytes - forward[2]),
        "backward": _with_least(difference(back, middle), forward[1] + weights),
        "clipping": _with_least(difference(clipped, back), weights if clip else 0),
        "optimizer": _with_least(difference(end, clipped), 3 * weights + 2 * states),
    }
    sums = [sum(values) for values in zip(*map(_fields, phases.values()), strict=True)]
    return {**phases, STEP: Cost(*sums), **meter.parts}


def _fields(cost: Cost) -> tuple[int, int, int]:
    return cost.macs, cost.least_bytes, cost.operator_bytes


def _with_least(cost: Cost, least_bytes: int) -> Cost:
    return Cost(cost.macs, least_bytes, cost.operator_bytes)


def loader_seconds(datamodule: SceneDataModule, samples: int) -> float:
    """CPU time of one sample of the training loader, in seconds: reading, augmentation, collation.

    Every frame is read once before, so that its object labels are cached.
    """
    dataset = datamodule.training_dataset()
    for index in range(len(dataset)):
        dataset[index]
    start = time.process_time()
    for number in range(samples):
        collate([dataset[number // len(dataset), number % len(dataset)]])
    return (time.process_time() - start) / samples
