"""The formats: writing a network, and loading what was written as a function of its inputs."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.export import ExportedProgram

from occdetr.errors import InputError
from occdetr.export.network import INPUTS, ImageToGrid
from occdetr.models.deformable_attention import reference_sampling

#: Of ONNX. TensorRT takes every mode of GridSample for "nearest" from opset 20 on.
OPSET = 18

Inputs = tuple[Tensor, Tensor, Tensor]
Runner = Callable[..., tuple[Tensor, ...]]


@dataclass(frozen=True)
class Format:
    """How a traced network is written to a file, and loaded again.

    ``check`` raises ``InputError`` if what both need is not installed. ``write`` gets the names of
    the outputs too.
    """

    suffix: str
    check: Callable[[], None]
    write: Callable[[ExportedProgram, tuple[str, ...], Path], None]
    load: Callable[[Path], Runner]


def trace(network: ImageToGrid, inputs: Inputs) -> ExportedProgram:
    """The network as one graph of PyTorch's own operators, in the shapes of the inputs."""
    with torch.no_grad(), reference_sampling():
        return torch.export.export(network, inputs)


def _check_onnx() -> None:
    for package in ("onnx", "onnxscript", "onnxruntime"):
        try:
            importlib.import_module(package)
        except ImportError as error:
            reason = " ".join(str(error).split())
            raise InputError(f"format=onnx: {reason}: pip install 'occdetr[export]'") from error


def _write_onnx(program: ExportedProgram, names: tuple[str, ...], path: Path) -> None:
    """Write and check one file with its weights inside."""
    import onnx  # pyright: ignore[reportMissingImports]

    # operators of torchvision that are not known, and patterns that are not found
    for name in ("torch.onnx._internal.exporter._registration", "onnxscript", "onnx_ir"):
        logging.getLogger(name).setLevel(logging.ERROR)
    given = {"input_names": INPUTS, "output_names": names, "opset_version": OPSET}
    torch.onnx.export(program, (), path, dynamo=True, external_data=False, verbose=False, **given)
    onnx.checker.check_model(str(path), full_check=True)


def _load_onnx(path: Path) -> Runner:
    """The network in ONNX Runtime on the CPU, with as many threads as PyTorch."""
    import onnxruntime  # pyright: ignore[reportMissingImports]

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        given = {name: x.cpu().numpy() for name, x in zip(INPUTS, inputs, strict=True)}
        return tuple(torch.from_numpy(array) for array in session.run(None, given))

    return run


def _write_program(program: ExportedProgram, _: tuple[str, ...], path: Path) -> None:
    torch.export.save(program, path)


def _load_program(path: Path) -> Runner:
    return torch.no_grad()(torch.export.load(path).module())


def _check_compiler() -> None:
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise InputError(
            "format=aot_inductor: no C++ compiler was found: install g++, or set the variable CXX"
        ) from error


def _write_package(program: ExportedProgram, _: tuple[str, ...], path: Path) -> None:
    torch._inductor.aoti_compile_and_package(program, package_path=str(path))


def _load_package(path: Path) -> Runner:
    return torch.no_grad()(torch._inductor.aoti_load_package(str(path)))


FORMATS = {
    "onnx": Format(".onnx", _check_onnx, _write_onnx, _load_onnx),
    "torch_export": Format(".pt2", lambda: None, _write_program, _load_program),
    "aot_inductor": Format(".pt2", _check_compiler, _write_package, _load_package),
}
