"""``vs=transformers``: the network beside Deformable DETR of Hugging Face's transformers."""

from __future__ import annotations

import functools
import importlib.metadata
import math
import os
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from occdetr.benchmark.sheet import Sheet
from occdetr.benchmark.sheets import peer_sheet
from occdetr.benchmark.subject import (
    Machine,
    build_network,
    check_threads,
    common_facts,
    street_batch,
)
from occdetr.data.parallel import in_processes
from occdetr.errors import InputError
from occdetr.evaluation.memory import tensor_memory_mb
from occdetr.evaluation.parts import frozen
from occdetr.evaluation.speed import macs_of, measure_alternating, summary
from occdetr.models.compilation import check_compiler
from occdetr.models.normalization import normalize_images
from occdetr.structures import SceneBatch
from occdetr.training.device import peak_memory_mb

PEER, NETWORK, DETECTOR = "peer", "ours", "our detector"
COMPILED = "ours, compiled"
STRIDES, QUERIES = (8, 16, 32, 64), 300  # the peer's


class Peer(nn.Module):
    """Deformable DETR with random weights: two stages, box refinement, ResNet-50, 300 queries.

    Raises ``InputError`` if transformers is not installed.
    """

    def __init__(self) -> None:
        super().__init__()
        check_peer()
        from transformers import (  # pyright: ignore[reportMissingImports]
            DeformableDetrConfig,
            DeformableDetrForObjectDetection,
            ResNetConfig,
        )

        backbone = ResNetConfig(out_features=["stage2", "stage3", "stage4"])
        config = DeformableDetrConfig(
            use_timm_backbone=False,
            backbone_config=backbone,
            two_stage=True,
            with_box_refine=True,
            num_queries=QUERIES,
            two_stage_num_proposals=QUERIES,
            disable_custom_kernels=True,  # they would be downloaded
        )
        self.network: Any = DeformableDetrForObjectDetection(config)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Any:
        batch, _, height, width = images.shape
        mask = torch.ones(batch, height, width, dtype=torch.long, device=images.device)
        return self.network(pixel_values=images, pixel_mask=mask)


def check_peer() -> None:
    """Raises ``InputError`` if transformers is not installed."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # nothing is downloaded
    try:
        import transformers  # noqa: F401 # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            f"vs=transformers: {' '.join(str(error).split())}: pip install 'occdetr[benchmark]'"
        ) from error


def check_image(size: Sequence[int]) -> None:
    """Raises ``InputError`` if an image has fewer tokens than the peer has queries."""
    tokens = sum(math.prod(math.ceil(side / stride) for side in size) for stride in STRIDES)
    if tokens < QUERIES:
        raise InputError(
            f"image_size={list(size)}: the peer selects {QUERIES} of its {tokens} tokens: "
            "use a larger image"
        )


def compare(config: DictConfig) -> tuple[dict[str, Any], Sheet]:
    """Time, multiply-adds and memory of the peer, of our network and of our detector alone.

    With ``config.compile`` also the time of our network as ``torch.compile`` makes it.

    Raises ``InputError`` if transformers is not installed, if there is no detector, if the image is
    too small for the peer, and if nothing can be compiled.
    """
    if config.model.detector is None:
        raise InputError(f"vs={config.vs}: partition={config.partition_name} has no detector")
    check_image(config.image_size)
    machine = Machine.chosen(config)
    if config.compile:
        check_compiler(machine.device)
    peer = Peer().to(machine.device).eval()
    model = build_network(config, machine)
    batch = street_batch(config)
    memory = {name: _memory_alone(config, name, batch) for name in (PEER, NETWORK, DETECTOR)}
    batch = batch.to(machine.device)
    calls = {
        PEER: _call(PEER, peer, batch, machine),
        NETWORK: _call(NETWORK, model, batch, machine),
        DETECTOR: _call(DETECTOR, model, batch, machine),
    }
    parts = {PEER: peer, NETWORK: model, DETECTOR: _detector_parts(model)}
    rows = {name: _facts(calls[name], parts[name], machine) for name in calls}
    for name, (_, peak) in memory.items():
        rows[name]["peak_memory_mb"] = round(peak, 1)
    if config.compile:
        calls[COMPILED] = torch.compile(calls[NETWORK])
        rows[COMPILED] = {key: rows[NETWORK][key] for key in ("params", "macs")}
    rounds = {"repeats": config.repeats, "warmup": config.warmup}
    times, cpu_per_wall = measure_alternating(calls, machine.device, **rounds)
    for name, row in rows.items():
        ratios = [own / other for own, other in zip(times[name], times[PEER], strict=True)]
        row |= {**summary(times[name]), "times_the_peer": round(statistics.median(ratios), 4)}
    report = {
        "part": "model",
        "mode": "predict",
        "vs": config.vs,
        "transformers": importlib.metadata.version("transformers"),
        **common_facts(config),
        **machine.facts(),
        "cpu_per_wall": round(cpu_per_wall, 3),
        "imports_mb": round(memory[PEER][0], 1),
        "networks": rows,
    }
    check_threads(machine, cpu_per_wall)
    return report, peer_sheet(report)


def _facts(call: Callable[[], Any], network: nn.Module, machine: Machine) -> dict[str, Any]:
    with frozen(network):
        macs = macs_of(call)
    return {
        "params": sum(parameter.numel() for parameter in network.parameters()),
        "macs": macs,
        "tensor_memory_mb": round(tensor_memory_mb(call, machine.device), 1),
    }


def _detector_parts(model: Any) -> nn.ModuleList:
    return nn.ModuleList([model.backbone, model.encoder, model.detector])


def _call(name: str, network: Any, batch: SceneBatch, machine: Machine) -> Callable[[], Any]:
    """A prediction of the peer, of the whole network, or of its detector alone."""
    calls: dict[str, Callable[[], Any]] = {
        PEER: lambda: network(normalize_images(batch.images)),
        NETWORK: lambda: network.predict(batch),
        DETECTOR: lambda: network.detect(network.encode(batch.images), batch.camera),
    }
    return torch.no_grad()(machine.autocast()(calls[name]))


def _memory_alone(config: DictConfig, name: str, batch: SceneBatch) -> tuple[float, float]:
    """``_peak_memory`` in a process of its own."""
    settings = OmegaConf.to_container(config, resolve=True)
    measure = functools.partial(_peak_memory, settings, batch=batch)
    (found,) = in_processes(measure, [name], workers=1)
    return found


def _peak_memory(settings: Any, name: str, batch: SceneBatch) -> tuple[float, float]:
    """The peak of this process in MiB, before the network is built and after two predictions."""
    config = DictConfig(settings)
    machine = Machine.chosen(config)
    before = peak_memory_mb(machine.device)
    network: Any = Peer().to(machine.device).eval() if name == PEER else None
    network = network or build_network(config, machine)
    call = _call(name, network, batch.to(machine.device), machine)
    for _ in range(2):
        call()
    return before, peak_memory_mb(machine.device)
