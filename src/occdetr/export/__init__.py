"""A trained network as a file for other programs.

``python -m occdetr.export checkpoint=... format=onnx|torch_export|aot_inductor [output=...]``
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from omegaconf import DictConfig

from occdetr.cli import entry as cli
from occdetr.errors import SHARE, InputError, check_range
from occdetr.evaluation.speed import measure_alternating, summary
from occdetr.export.formats import FORMATS, OPSET, Format, Inputs, trace
from occdetr.export.network import INPUTS, ImageToGrid
from occdetr.export.parity import Parity, compare
from occdetr.export.street import street_inputs
from occdetr.files import check_folder, replacing, write_json
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.checkpoint import UNTRAINED_GRIDS, restore_model
from occdetr.training.device import choose_device
from occdetr.training.trainer import seed_everything

#: Exit code if the exported network differs from the network itself.
DIFFERS = 1


@cli.entry_point("export")
def main(config: DictConfig) -> None:
    """Write the network, compare it with the eager one on a synthetic street, and time both.

    ``export.json`` in the run's folder has what is printed. If the two differ the exit code is
    ``DIFFERS`` and the file is not kept.
    """
    seed_everything(config.seed)
    checkpoint = cli.required(config, "checkpoint", "outputs/full/<run>/best.ckpt")
    name = cli.required(config, "format", "onnx")
    if name not in FORMATS:
        raise InputError(f"format={name}: choose one of {', '.join(FORMATS)}")
    chosen = FORMATS[name]
    output = _output(config, chosen)
    chosen.check()
    check_range("score_threshold", config.score_threshold, SHARE)
    device = choose_device(config.device)
    model, trained = restore_model(checkpoint, cli.plain(config.allow))
    if config.score_threshold is not None:
        model.fusion.score_threshold = float(config.score_threshold)
    if trained.stage == "pretrain":
        print(f"note: {checkpoint}: {UNTRAINED_GRIDS}", flush=True)
    inputs = street_inputs(config, model, device)
    with TemporaryDirectory() as folder:
        file = Path(folder, f"network{chosen.suffix}")
        report, parity = export(config, model.to(device), inputs, file)
        if parity.failure is None:
            with replacing(output) as temporary:
                shutil.copyfile(file, temporary)
    kept = str(output) if parity.failure is None else None
    about = {"checkpoint": str(checkpoint), "output": kept, "format": name, **report}
    write_json(cli.run_folder() / "export.json", about)
    if parity.failure is not None:
        print(f"error: format={name}: {parity.failure}: it was not kept", file=sys.stderr)
        sys.exit(DIFFERS)
    print(f"done: {cli.shown(output)} ({output.stat().st_size / 2**20:.1f} MiB)")


def export(
    config: DictConfig, model: OccupancyDETR, inputs: Inputs, file: Path
) -> tuple[dict[str, Any], Parity]:
    """Write ``file``, load it and compare; prints and returns what came out."""
    chosen = FORMATS[config.format]
    network = ImageToGrid(model, torch.float32).eval()
    chosen.write(trace(network, inputs), network.output_names, file)
    exported, eager = chosen.load(file), torch.no_grad()(ImageToGrid(model).eval())
    expected, found = (
        dict(zip(network.output_names, run(*inputs), strict=True)) for run in (eager, exported)
    )
    parity = compare(expected, found)
    print(f"parity on a synthetic street: {parity}", flush=True)
    runners = {"eager": lambda: eager(*inputs), "exported": lambda: exported(*inputs)}
    device = inputs[0].device
    times, _ = measure_alternating(runners, device, repeats=config.repeats, warmup=1)
    latency = {name: summary(seconds) for name, seconds in times.items()}
    own, other = (latency[name]["latency_ms"] for name in runners)
    place = "the CPU" if config.format == "onnx" else device.type
    print(
        f"latency: eager {own:.0f} ms on {device.type}, {config.format} {other:.0f} ms on {place} "
        f"({other / own:.2f} times)",
        flush=True,
    )
    report = {
        "opset": OPSET if config.format == "onnx" else None,
        "inputs": _described(dict(zip(INPUTS, inputs, strict=True))),
        "outputs": _described(found),
        "score_threshold": model.fusion.score_threshold,
        "parity": vars(parity),
        "latency": latency,
        "device": device.type,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
    return report, parity


def _output(config: DictConfig, chosen: Format) -> Path:
    """Where the file is to be. Raises ``InputError`` if its name does not fit the format, or if
    nothing can be written there."""
    if config.output is None:
        return cli.run_folder() / f"network{chosen.suffix}"
    output = Path(str(config.output)).expanduser()
    if output.suffix != chosen.suffix:
        raise InputError(f"output={output}: give a file name that ends with {chosen.suffix}")
    if output.is_dir():
        raise InputError(f"output={output}: is a folder: give the name of a file")
    check_folder("output", output.parent, writable=True)
    return output


def _described(tensors: dict[str, torch.Tensor]) -> dict[str, str]:
    """Type and shape of each tensor."""
    return {
        name: f"{str(x.dtype).removeprefix('torch.')} {list(x.shape)}"
        for name, x in tensors.items()
    }


if __name__ == "__main__":
    main()
