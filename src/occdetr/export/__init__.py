"""A trained network as a file for other programs.

``python -m occdetr.export checkpoint=... format=onnx|torch_export|aot_inductor [output=...]``

``format=safetensors`` is for this package: the weights and the configuration of a checkpoint in one
file, which ``checkpoint=`` takes, without what only its run needs.
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
from occdetr.export.formats import FORMATS, OPSET, Format, Inputs, Runner, trace
from occdetr.export.network import INPUTS, OUTPUTS, ImageToGrid
from occdetr.export.parity import Parity, compare
from occdetr.export.street import street_inputs
from occdetr.files import check_folder, replacing, write_json
from occdetr.models.occdetr import OccupancyDETR
from occdetr.training.checkpoint import UNTRAINED_GRIDS, Checkpoint, restore_model
from occdetr.training.device import choose_device
from occdetr.training.released import SUFFIX, write_released
from occdetr.training.trainer import seed_everything

#: The format of the weights alone.
WEIGHTS = "safetensors"
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
    chosen = FORMATS.get(name)
    if chosen is None and name != WEIGHTS:
        raise InputError(f"format={name}: choose one of {', '.join([*FORMATS, WEIGHTS])}")
    output = _output(config, SUFFIX if chosen is None else chosen.suffix)
    check_range("score_threshold", config.score_threshold, SHARE)
    if chosen is not None:
        chosen.check()
    elif config.score_threshold is not None:
        raise InputError(
            f"score_threshold={config.score_threshold}: is not kept with the weights: leave it out"
        )
    device = choose_device(config.device)
    model, trained = restore_model(checkpoint, cli.plain(config.allow))
    if config.score_threshold is not None:
        model.fusion.score_threshold = float(config.score_threshold)
    if trained.stage == "pretrain":
        print(f"note: {checkpoint}: {UNTRAINED_GRIDS}", flush=True)
    inputs = street_inputs(config, model, device)
    with TemporaryDirectory() as folder:
        file = Path(folder, f"network{output.suffix}")
        if chosen is None:
            report, failure = export_weights(trained, model.to(device), inputs, file)
        else:
            report, failure = export(config, chosen, model.to(device), inputs, file)
        if failure is None:
            with replacing(output) as temporary:
                shutil.copyfile(file, temporary)
    kept = str(output) if failure is None else None
    about = {"checkpoint": str(checkpoint), "output": kept, "format": name, **report}
    write_json(cli.run_folder() / "export.json", about)
    if failure is not None:
        print(f"error: format={name}: {failure}: it was not kept", file=sys.stderr)
        sys.exit(DIFFERS)
    print(f"done: {cli.shown(output)} ({output.stat().st_size / 2**20:.1f} MiB)")


def export_weights(
    trained: Checkpoint, model: OccupancyDETR, inputs: Inputs, file: Path
) -> tuple[dict[str, Any], str | None]:
    """Write ``file``, and print what rounding to bf16 changes. Like ``export``; only what is not
    finite makes the file useless."""
    about = {"stage": trained.stage, "version": trained.version}
    write_released(file, model.state_dict(), trained.config, **about)
    rounded, _ = restore_model(file, trained.allow)
    parity = _compare(ImageToGrid(model), ImageToGrid(rounded.to(inputs[0].device)), inputs)
    print(f"after rounding to bf16, on a synthetic street: {parity}", flush=True)
    return {"parity": vars(parity)}, parity.failure if not parity.finite else None


def export(
    config: DictConfig, chosen: Format, model: OccupancyDETR, inputs: Inputs, file: Path
) -> tuple[dict[str, Any], str | None]:
    """Write ``file``, load it and compare; prints and returns what came out, and why the file must
    not be used, if so."""
    network = ImageToGrid(model, torch.float32).eval()
    chosen.write(trace(network, inputs), network.output_names, file)
    exported, eager = chosen.load(file), torch.no_grad()(ImageToGrid(model).eval())
    parity = _compare(eager, exported, inputs)
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
        "outputs": _described(dict(zip(network.output_names, exported(*inputs), strict=True))),
        "score_threshold": model.fusion.score_threshold,
        "parity": vars(parity),
        "latency": latency,
        "device": device.type,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
    return report, parity.failure


def _compare(network: Runner, other: Runner, inputs: Inputs) -> Parity:
    with torch.no_grad():
        outputs = [run(*inputs) for run in (network, other)]
    names = OUTPUTS[: len(outputs[0])]
    return compare(*(dict(zip(names, values, strict=True)) for values in outputs))


def _output(config: DictConfig, suffix: str) -> Path:
    """Where the file is to be. Raises ``InputError`` if its name does not fit the format, or if
    nothing can be written there."""
    if config.output is None:
        return cli.run_folder() / f"network{suffix}"
    output = Path(str(config.output)).expanduser()
    if output.suffix != suffix:
        raise InputError(f"output={output}: give a file name that ends with {suffix}")
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
