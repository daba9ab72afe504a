"""Exported networks give what the network gives, in each format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from model_factory import IMAGE_SIZE, camera, tiny_model
from occdetr.export.formats import FORMATS, OPSET, trace
from occdetr.export.network import INPUTS, OUTPUTS, ImageToGrid
from occdetr.export.parity import compare
from occdetr.models.occdetr import OccupancyDETR


@pytest.fixture(scope="module")
def model() -> OccupancyDETR:
    """A network that writes all its objects into the grid."""
    model = tiny_model(overrides=["model.slots.num_slots=4"]).eval()
    model.fusion.score_threshold = 0.0
    return model


@pytest.fixture(scope="module")
def inputs() -> tuple[Any, ...]:
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (1, 3, *IMAGE_SIZE), dtype=torch.uint8, generator=generator)
    view = camera(1)
    return image, view.projection, view.lidar_to_camera


@pytest.fixture(scope="module")
def program(model: OccupancyDETR, inputs: tuple[Any, ...]) -> torch.export.ExportedProgram:
    return trace(ImageToGrid(model, torch.float32).eval(), inputs)


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("onnx", "aot_inductor")]


@pytest.mark.parametrize("name", ["torch_export", *SLOW])
def test_what_is_loaded_gives_what_the_network_gives(
    name: str, model: OccupancyDETR, inputs: tuple[Any, ...], program: Any, tmp_path: Path
) -> None:
    if name == "onnx":
        pytest.importorskip("onnx")
    chosen = FORMATS[name]
    chosen.check()
    path = tmp_path / f"network{chosen.suffix}"
    chosen.write(program, OUTPUTS, path)
    assert [*tmp_path.iterdir()] == [path]
    with torch.no_grad():
        expected = dict(zip(OUTPUTS, ImageToGrid(model)(*inputs), strict=True))
    found = dict(zip(OUTPUTS, chosen.load(path)(*inputs), strict=True))
    assert expected["grid"].unique().numel() > 2
    for key in OUTPUTS:
        assert found[key].shape == expected[key].shape
        assert found[key].dtype == expected[key].dtype
    parity = compare(expected, found)
    assert parity.failure is None
    assert parity.voxels > 0.9999
    assert parity.objects["classes"] == 1
    assert max(parity.objects[key] for key in ("boxes_xyxy", "boxes3d", "scores")) < 1e-2
    if name == "onnx":
        check_that_tensorrt_takes(path)


def test_the_graph_has_pytorchs_operators_alone(program: Any) -> None:
    targets = {str(node.target) for node in program.graph.nodes if node.op == "call_function"}
    assert any("grid_sampler" in target for target in targets)
    assert not [target for target in targets if "occdetr" in target]
    assert not [target for target in targets if "index_add" in target or "put" in target]


def check_that_tensorrt_takes(path: Path) -> None:
    """The operators of an ONNX file, as far as docs/export.md names limits."""
    onnx = pytest.importorskip("onnx")
    loaded = onnx.shape_inference.infer_shapes(onnx.load(path))
    assert {entry.domain: entry.version for entry in loaded.opset_import}[""] == OPSET == 18
    graph, types = loaded.graph, onnx.TensorProto
    assert tuple(value.name for value in graph.input) == INPUTS
    assert tuple(value.name for value in graph.output) == OUTPUTS
    kinds = {value.name: value.type.tensor_type.elem_type for value in graph.value_info}
    assert types.UINT8 not in kinds.values()  # bytes at the ends alone
    for node in graph.node:
        given = {each.name: onnx.helper.get_attribute_value(each) for each in node.attribute}
        assert given.get("reduction", b"none") == b"none"
        if node.op_type == "GridSample":
            assert given.get("mode", b"bilinear") == b"bilinear"
        if "grid" in node.output:
            assert node.op_type == "Cast"
            assert kinds[node.input[0]] == types.FLOAT


@pytest.mark.parametrize("partition", ["all_foreground", "all_background"])
def test_other_partitions(partition: str, inputs: tuple[Any, ...]) -> None:
    network = ImageToGrid(tiny_model(partition).eval(), torch.float32)
    with torch.no_grad():
        found = network(*inputs)
    assert len(found) == len(network.output_names)
    assert network.output_names == (OUTPUTS if partition == "all_foreground" else ("grid",))
    assert found[0].shape == (1, 256, 256, 32)
    assert found[0].dtype == torch.uint8
