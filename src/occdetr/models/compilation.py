"""The network compiled by ``torch.compile``, in place."""

from __future__ import annotations

from typing import Any

import torch

from occdetr.errors import InputError
from occdetr.models.occdetr import OccupancyDETR


def compile_network(model: OccupancyDETR, device: torch.device, backend: Any = "inductor") -> None:
    """Compile the network and its parts, each at its first call with inputs of a shape.

    Evaluation and prediction call the network, as one graph, and its fusion; training calls its
    other parts. The modules stay the same ones, and so do the names of their weights.

    Raises ``InputError`` if nothing can be compiled for ``device``.
    """
    check_compiler(device, backend)
    for module in (model, *model.children()):
        module.compile(backend=backend, fullgraph=True, dynamic=False)


def check_compiler(device: torch.device, backend: Any = "inductor") -> None:
    """Compile a small function. Raises ``InputError`` if that fails."""
    from torch._inductor import config  # takes a second

    function = torch.compile(lambda x: x + 1, backend=backend)
    try:
        with config.patch(fx_graph_cache=False):  # whatever was compiled before
            function(torch.ones(8, device=device))
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(
            f"compile=true: nothing can be compiled for {device.type} on this machine ({reason}): "
            "install a C++ compiler, as in apt-get install g++, or give compile=false"
        ) from error
