"""Everything that has to be checked on a GPU, in one run.

    python scripts/gpu_check.py                            # on the GPU
    python scripts/gpu_check.py --device cpu --model tiny  # a trial of the script itself

It runs ``tests/test_cuda.py``, then times predictions (eager, compiled, and both replayed as a CUDA
graph) and training steps of ``stage=full`` with all losses in float32 and bf16, and compares them
with ``GOALS``. Results go to ``gpu_check.json`` in ``--output``. Checks that would begin after
``--minutes`` are left out, and named. The exit code is 1 if a check failed, a goal was missed or a
check was left out.
"""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from occdetr.benchmark.subject import Machine, build_network
from occdetr.cli import entry as cli
from occdetr.data.dataset import collate
from occdetr.evaluation.limits import measure_limits
from occdetr.evaluation.speed import measure_latency
from occdetr.models.compilation import compile_network
from occdetr.training.optimizer import make_optimizer

ROOT = Path(__file__).parents[1]
PRECISIONS = ("bf16-mixed", "32-true")
#: By figure: the most (milliseconds, GB) or the least (samples per second) that is wanted.
GOALS = {
    "predict 32-true least ms": 20.0,
    "predict bf16-mixed least ms": 10.0,
    "predict bf16-mixed most peak GB": 8.0,
    "predict 32-true most peak GB": 8.0,
    "train most samples/s": 25.0,
}


class Report:
    """Figures by name, and what failed or was left out; printed as they come."""

    def __init__(self, output: Path, deadline: float) -> None:
        self.output, self.deadline = output, deadline
        self.figures: dict[str, Any] = {}
        self.problems: list[str] = []

    def check(self, name: str, function: Callable[[], dict[str, Any]]) -> None:
        """Run a check if there is time, and keep its figures or what went wrong."""
        if time.monotonic() > self.deadline:
            self.problems.append(f"{name}: left out, no time")
            print(self.problems[-1], flush=True)
            return
        began = time.monotonic()
        try:
            found = function()
        except Exception as error:  # the next check may still say something
            traceback.print_exc()
            reason = (str(error).splitlines() or [""])[0]
            self.problems.append(f"{name}: {type(error).__name__}: {reason}")
            found = {}
        self.figures |= found
        shown = ", ".join(f"{key}: {value}" for key, value in found.items())
        print(f"[{time.monotonic() - began:5.1f} s] {name}: {shown or 'no figures'}", flush=True)
        self.write()

    def judge(self) -> None:
        """The best of each kind of figure, and the goals that were missed."""
        for precision in PRECISIONS:
            self._summarize(f"predict {precision}", "ms", min)
            self._summarize(f"predict {precision}", "peak GB", max)
        self._summarize("train", "samples/s", max)
        for name, goal in GOALS.items():
            value = self.figures.get(name)
            least = name.endswith("samples/s")
            if value is None or (value < goal if least else value > goal):
                self.problems.append(f"{name}: {value}, wanted {'>=' if least else '<='} {goal}")
        self.write()

    def _summarize(self, start: str, unit: str, choose: Callable[..., float]) -> None:
        named = self.figures.items()
        values = [v for name, v in named if name.startswith(start) and name.endswith(unit)]
        if values:
            word = "least" if choose is min else "most"
            self.figures[f"{start} {word} {unit}"] = choose(values)

    def write(self) -> None:
        text = json.dumps({"figures": self.figures, "problems": self.problems}, indent=2)
        (self.output / "gpu_check.json").write_text(text + "\n")


def main() -> int:
    options = parsed()
    options.output.mkdir(parents=True, exist_ok=True)
    report = Report(options.output, time.monotonic() + 60 * options.minutes)
    report.check("machine", lambda: facts(options.device))
    if options.device == "cuda":
        report.check("tests", run_tests)
    for compiled in (False, True):  # what takes longest comes last
        form = "compiled" if compiled else "eager"
        for check in (predictions, training):
            for precision in PRECISIONS:
                run = functools.partial(check, options, precision, compiled=compiled)
                report.check(f"{check.__name__} {precision} {form}", run)
    report.judge()
    print("\n".join(["", *(report.problems or ["every check passed, every goal was reached"])]))
    return 1 if report.problems else 0


def facts(device: str) -> dict[str, Any]:
    on_gpu = device == "cuda"
    limits = measure_limits(torch.device(device), torch.bfloat16)
    return {
        "device": torch.cuda.get_device_name() if on_gpu else "cpu",
        "torch": torch.__version__,
        "TFLOP/s": round(limits.flops / 1e12, 2),
        "GB/s": round(limits.bandwidth / 1e9, 1),
    }


def run_tests() -> dict[str, Any]:
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, "tests/test_cuda.py"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    print(done.stdout[-6000:])
    if done.returncode:
        raise RuntimeError("tests/test_cuda.py failed")
    return {"tests": done.stdout.splitlines()[-1]}


def made(options: argparse.Namespace, precision: str, batch: int) -> tuple[Any, Machine, Any]:
    """Configuration, machine, and a batch of a street that lies in the output folder."""
    config = cli.compose("benchmark", [f"model={options.model}", f"batch_size={batch}"])
    config.device, config.precision = options.device, precision
    machine = Machine.chosen(config)
    datamodule = cli.build(config.scene, root=str(options.output / f"street-{options.model}"))
    datamodule.prepare_data()
    return config, machine, collate([datamodule.dataset("train")[0]] * batch).to(machine.device)


def predictions(options: argparse.Namespace, precision: str, *, compiled: bool) -> dict[str, Any]:
    """Time and memory of a prediction at batch 1, called and replayed as a CUDA graph."""
    config, machine, batch = made(options, precision, 1)
    model, form = build_network(config, machine), "compiled" if compiled else "eager"
    if compiled:
        compile_network(model, machine.device)
    on_gpu = machine.device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()

    def predict() -> torch.Tensor:
        with machine.autocast():
            return model.predict(batch)[1]

    rounds = {"repeats": options.repeats, "warmup": 3}
    name = f"predict {precision}"
    latency = measure_latency(predict, machine.device, **rounds)
    found = {f"{name} {form} ms": latency["latency_ms"]}
    if on_gpu:
        found[f"{name} {form} peak GB"] = round(torch.cuda.max_memory_allocated() / 1e9, 3)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            grid = predict()
        replayed = measure_latency(graph.replay, machine.device, **rounds)
        found[f"{name} {form} graph ms"] = replayed["latency_ms"]
        if not torch.equal(grid, predict()):
            raise RuntimeError("the replayed CUDA graph gives another grid")
    return found


def training(options: argparse.Namespace, precision: str, *, compiled: bool) -> dict[str, Any]:
    """Samples per second of ``stage=full``: forward pass, all losses, backward pass, clipping and
    optimizer, without the loader."""
    config, machine, batch = made(options, precision, options.batch)
    module = cli.build(config.module, model=build_network(config, machine)).train()
    module.to(machine.device)
    module.model.backbone.freeze_statistics()
    if compiled:
        compile_network(module.model, machine.device)
    parameters = [p for p in module.parameters() if p.requires_grad]
    optimizer = make_optimizer(module.model, module.optimizer_settings)

    def step() -> None:
        with machine.autocast():
            loss = torch.stack(list(module.losses(batch).values())).sum()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, config.trainer.gradient_clip_val)
        optimizer.step()
        optimizer.zero_grad()

    latency = measure_latency(step, machine.device, repeats=options.repeats, warmup=3)
    name = f"train {precision} {'compiled' if compiled else 'eager'}"
    return {f"{name} samples/s": round(1000 * options.batch / latency["latency_ms"], 2)}


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--model", default="paper")
    parser.add_argument("--batch", type=int, default=4, help="of a training step")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--output", type=Path, default=Path("outputs/gpu_check"))
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
