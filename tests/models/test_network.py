"""The network: parity, static shapes, gradients, batches."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor

from model_factory import IMAGE_SIZE, camera, small_batch, tiny_config, tiny_model
from occdetr.cli.entry import compose
from occdetr.errors import InputError
from occdetr.geometry.boxes import bounds_in_grid, boxes3d_to_grid
from occdetr.geometry.camera import denormalize_pixels, project_points
from occdetr.geometry.rois import RoiLayout
from occdetr.geometry.subdivision import (
    child_boxes,
    child_cells,
    project_boxes,
    project_centers,
)
from occdetr.models.deformable_attention import deformable_sampling
from occdetr.models.detector import unproject_boxes3d
from occdetr.models.layers import BoxHead
from occdetr.models.line_of_sight import LineOfSight
from occdetr.models.normalization import normalize_images
from occdetr.models.occupancy_queries import ObjectQueries
from occdetr.models.query_selection import QuerySelection
from occdetr.models.resnet import ResNet
from occdetr.structures import Memory


def loop_sampling(
    value: Tensor, shapes: list[tuple[int, int]], locations: Tensor, weights: Tensor
) -> Tensor:
    """Equation 3 of Deformable DETR, one sample after the other."""
    batch, _, heads, channels = value.shape
    queries, levels, points = locations.shape[1], locations.shape[4], locations.shape[5]
    out = torch.zeros(batch, queries, heads, channels, dtype=value.dtype)
    for b in range(batch):
        for q in range(queries):
            for h in range(heads):
                start = 0
                for level in range(levels):
                    rows, columns = shapes[level]
                    for p in range(points):
                        x, y = locations[b, q, :, h, level, p].tolist()
                        u, v = x * columns - 0.5, y * rows - 0.5
                        for i in (math.floor(v), math.floor(v) + 1):
                            for j in (math.floor(u), math.floor(u) + 1):
                                if 0 <= i < rows and 0 <= j < columns:
                                    share = (1 - abs(v - i)) * (1 - abs(u - j))
                                    token = value[b, start + i * columns + j, h]
                                    out[b, q, h] += weights[b, q, h, level, p] * share * token
                    start += rows * columns
    return out.flatten(2)


def test_deformable_sampling_equals_a_loop() -> None:
    generator = torch.Generator().manual_seed(0)
    shapes = [(5, 7), (3, 4)]
    value = torch.randn(2, 47, 2, 3, generator=generator, dtype=torch.float64)
    locations = torch.rand(2, 6, 2, 2, 2, 3, generator=generator, dtype=torch.float64) * 1.4 - 0.2
    weights = torch.rand(2, 6, 2, 2, 3, generator=generator, dtype=torch.float64)
    expected = loop_sampling(value, shapes, locations, weights)
    found = deformable_sampling(value, shapes, locations, weights)
    assert (found - expected).abs().max() < 1e-10


def test_resnet_has_torchvisions_names_and_counts() -> None:
    with torch.device("meta"):
        state = ResNet(50).state_dict()
    names = {"conv1.weight", "bn1.running_mean", "layer1.0.downsample.0.weight"}
    assert names <= set(state)
    assert state["layer3.5.conv3.weight"].shape == (1024, 256, 1, 1)
    # torchvision's ResNet-50 has 25,557,032 parameters, its classifier 2,049,000
    parameters = sum(v.numel() for n, v in state.items() if "running" not in n and "num_" not in n)
    assert parameters == 25_557_032 - 2_049_000


def test_resnet_loads_a_file_and_says_what_is_wrong(tmp_path) -> None:
    torch.manual_seed(0)
    source = ResNet(18, freeze_norm=False)
    path = tmp_path / "resnet18.pth"
    torch.save(source.state_dict() | {"fc.weight": torch.zeros(1000, 512)}, path)
    loaded = ResNet(18, weights=str(path))
    assert torch.equal(loaded.layer4[1].conv2.weight, source.layer4[1].conv2.weight)
    with pytest.raises(InputError, match="no such file"):
        ResNet(18, weights=str(tmp_path / "absent.pth"))
    with pytest.raises(InputError, match="does not hold a ResNet-50"):
        ResNet(50, weights=str(path))
    changes = (torch.nan, torch.int8, torch.complex64)
    for change in changes:
        weight = source.conv1.weight.detach()
        other = weight * change if isinstance(change, float) else weight.to(change)
        torch.save(source.state_dict() | {"conv1.weight": other}, path)
        with pytest.raises(InputError, match=r"does not hold a ResNet-18 .*: conv1\.weight"):
            ResNet(18, weights=str(path))
    path.write_bytes(b"not weights")
    with pytest.raises(InputError, match="not a PyTorch state dict"):
        ResNet(18, weights=str(path))


def test_a_file_with_an_official_name_has_its_hash(tmp_path) -> None:
    path = tmp_path / "resnet18-f37072fd.pth"
    torch.save(ResNet(18).state_dict(), path)
    with pytest.raises(InputError, match=r"resnet18-f37072fd\.pth: damaged"):
        ResNet(18, weights=str(path))


def test_frozen_norm_keeps_its_statistics() -> None:
    frozen, learning = ResNet(18, freeze_norm=True), ResNet(18, freeze_norm=False)
    for net, moves in ((frozen, False), (learning, True)):
        before = net.bn1.running_mean.clone()
        net.train()(torch.randn(2, 3, 64, 64))
        assert torch.equal(net.bn1.running_mean, before) != moves


def test_3d_boxes_project_to_where_the_head_says() -> None:
    view = camera(2)
    raw = torch.randn(2, 5, 6) * 0.3
    boxes = torch.rand(2, 5, 4) * 0.5 + 0.1
    found = unproject_boxes3d(raw, boxes, view)
    pixels, depth = project_points(found[..., :3], view.projection)
    expected = denormalize_pixels(boxes[..., :2] + raw[..., :2] * boxes[..., 2:], IMAGE_SIZE)
    assert torch.allclose(pixels, expected, atol=1e-2)
    assert torch.allclose(depth - view.projection[:, 2, 3, None], found[..., 2], atol=1e-5)
    assert torch.allclose(found[..., 3:], raw[..., 3:].exp())


def test_children_tile_their_parents() -> None:
    cells = torch.tensor([[[1, 2, 3]]])
    assert child_cells(cells)[0, [0, 1, 2, 4]].tolist() == [
        [2, 4, 6],
        [2, 4, 7],
        [2, 5, 6],
        [3, 4, 6],
    ]
    box = torch.tensor([[[1.0, 2.0, 3.0, 2.0, 4.0, 8.0]]])
    children = child_boxes(box)
    assert children.shape == (1, 8, 6)
    assert children[0, 0].tolist() == [0.5, 1.0, 1.0, 1.0, 2.0, 4.0]
    lower = (children[..., :3] - children[..., 3:] / 2).amin(1)
    upper = (children[..., :3] + children[..., 3:] / 2).amax(1)
    assert torch.equal(torch.cat([(lower + upper) / 2, upper - lower], -1), box[:, 0])


def test_foreground_grid_is_in_spatial_order() -> None:
    decoder = tiny_model().occupancy_decoder
    boxes = torch.tensor([[[10.0, 0.0, 0.0, 8.0, 8.0, 8.0]]])
    for _ in range(3):
        boxes = child_boxes(boxes)
    # as the head's output for 4 x 4 x 4 cells of each of 8 x 8 x 8 children: their places
    steps = (torch.arange(4) - 1.5) * 0.25
    inner = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"))
    cells = boxes[0, :, :3, None, None, None] + inner
    decoder.foreground_head = torch.nn.Identity()
    centers = (torch.arange(32) + 0.5) * 0.25 - 4.0
    for axis, middle in enumerate((10.0, 0.0, 0.0)):
        grid = decoder._foreground_grid(cells[:, axis].reshape(1, -1, 64), slots=1)[0, 0]
        shape = [32 if a == axis else 1 for a in range(3)]
        assert torch.allclose(grid, (middle + centers).reshape(shape).expand(32, 32, 32))


def test_geometry_and_boxes_stay_exact_under_autocast() -> None:
    view = camera(1)
    boxes = torch.tensor([[[40.3, -7.7, 0.9, 0.2, 0.2, 3.0], [12.1, 3.3, -1.0, 4.0, 1.8, 1.6]]])
    projected = project_boxes(boxes, view)
    moved = [move(boxes, view.lidar_to_camera) for move in (bounds_in_grid, boxes3d_to_grid)]
    head = BoxHead(16, 16, 6, 2)
    torch.nn.init.normal_(head[-1].weight)
    queries = torch.randn(1, 3, 16)
    said = head(queries)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(project_boxes(boxes, view), projected)
        assert torch.equal(bounds_in_grid(boxes, view.lidar_to_camera), moved[0])
        assert torch.equal(boxes3d_to_grid(boxes, view.lidar_to_camera), moved[1])
        assert torch.equal(head(queries), said)


def test_forced_tokens_stand_in_order_of_score() -> None:
    """A query's place must not tell whether its token was forced: learned contents go by place."""
    torch.manual_seed(0)
    selection = QuerySelection(
        RoiLayout(IMAGE_SIZE, (4, 8, 16, 32), 2.0), range(8), 100, 32, content="learned"
    )
    memory = Memory(torch.randn(2, len(selection.rois), 32), [])
    score = selection(memory)[0].pred_logits.amax(-1)
    forced = torch.zeros(score.shape, dtype=torch.bool)
    forced[0, score[0].argmin()] = forced[1, score[1].argmin()] = True
    forced[1, score[1].argmax()] = True
    _, selected, content, _ = selection(memory, forced)
    chosen = score.gather(1, selected)
    assert (chosen.diff(dim=1) <= 0).all()
    assert (selected[:, -1] == score.argmin(1)).all()
    assert selected[1, 0] == score[1].argmax()
    assert torch.equal(content[1], selection.learned.weight)


def test_line_of_sight_gives_the_tokens_at_the_points() -> None:
    torch.manual_seed(0)
    sight = LineOfSight(hidden_dim=8, num_levels=2, width=5, num_kinds=2)
    memory = Memory(torch.randn(1, 4 * 6 + 2 * 3, 8), [(4, 6), (2, 3)])
    middle = torch.tensor([[[(2 + 0.5) / 6, (1 + 0.5) / 4]]])  # of row 1, column 2
    value = sight.value_proj(memory.tokens)[0]
    coarse = value[24:].view(2, 3, 5)  # at 0.25 of a row and 0.75 of a column between the centres
    x, y = 1.25 - 0.5, 0.75 - 0.5
    between = (1 - y) * ((1 - x) * coarse[0, 0] + x * coarse[0, 1])
    between = between + y * ((1 - x) * coarse[1, 0] + x * coarse[1, 1])
    expected = sight.output_projs[1](torch.cat([value[1 * 6 + 2], between]))
    found = sight(sight.maps(memory), middle, kind=1)
    assert torch.allclose(found[0, 0], expected, atol=1e-5)
    outside = sight(sight.maps(memory), torch.tensor([[[-1.0, 2.0]]]), kind=1)
    assert torch.allclose(outside[0, 0], sight.output_projs[1].bias)


def test_line_of_sight_is_grid_sample() -> None:
    """In several frames, values and gradients."""
    torch.manual_seed(0)
    sight = LineOfSight(hidden_dim=8, num_levels=2, width=5, num_kinds=1)
    tokens = torch.randn(3, 4 * 6 + 2 * 3, 8, requires_grad=True)
    memory, points = Memory(tokens, [(4, 6), (2, 3)]), torch.rand(3, 50, 2) * 1.4 - 0.2
    value = sight.value_proj(tokens).transpose(1, 2)
    images = (value[..., :24].unflatten(2, (4, 6)), value[..., 24:].unflatten(2, (2, 3)))
    grid = 2 * points[:, None] - 1
    seen = [F.grid_sample(image, grid, align_corners=False)[:, :, 0] for image in images]
    expected = sight.output_projs[0](torch.cat(seen, dim=1).transpose(1, 2))
    found = sight(sight.maps(memory), points, kind=0)
    assert torch.allclose(found, expected, atol=1e-6)
    weight = torch.randn_like(found)
    leaves = [tokens, *sight.parameters()]
    pairs = [torch.autograd.grad((x * weight).sum(), leaves) for x in (found, expected)]
    assert all(torch.allclose(*pair, atol=1e-4) for pair in zip(*pairs, strict=True))


def test_children_see_where_they_are() -> None:
    """With the attention cut off, a cell's score hangs on the pixels at its own centre."""
    model = tiny_model("all_background").eval()
    decoder, view = model.occupancy_decoder, camera(1)
    for layer in decoder.layers:
        torch.nn.init.zeros_(layer.cross_attention.output_proj.weight)
        torch.nn.init.zeros_(layer.self_attention.output_proj.weight)
    shapes = [(32, 104), (16, 52), (8, 26), (4, 13)]
    memory = torch.randn(1, sum(r * c for r, c in shapes), 96, requires_grad=True)
    none = torch.zeros(1, 0)
    objects = ObjectQueries(
        torch.zeros(1, 0, 96), torch.zeros(1, 0, 0), torch.zeros(1, 0, 6), none > 0
    )
    _, background = decoder(objects, Memory(memory, shapes), view)
    level = background.levels[0]
    cell = (level.coordinates[0] == torch.tensor([8, 14, 0])).all(1).nonzero().item()
    level.logits[0, cell].backward()
    felt = memory.grad[0, : 32 * 104].abs().sum(1).view(32, 104).nonzero()
    own = [8.5 * 1.6, 14.5 * 1.6 - 25.6, 0.5 * 1.6 - 2.0]
    parents = [4.5 * 3.2, 7.5 * 3.2 - 25.6, 0.5 * 3.2 - 2.0]
    boxes = torch.tensor([[own + [1.6] * 3, parents + [3.2] * 3]])
    points = project_centers(boxes, view)
    framed = project_boxes(boxes, view)
    assert torch.equal(points, framed[..., :2])
    places = (points[0].flip(1) * torch.tensor([32, 104]) - 0.5).int().tolist()
    around = {(row + i, column + j) for row, column in places for i in (0, 1) for j in (0, 1)}
    assert {(row, column) for row, column in felt.tolist()} == around


@pytest.mark.parametrize("partition", ["mixed", "all_foreground", "all_background"])
def test_batched_equals_single(partition: str) -> None:
    model = tiny_model(partition).eval()
    batch = small_batch(2)
    with torch.no_grad():
        together = model(batch.images, batch.camera).occupancy
        for b in range(2):
            alone = model(batch.images[b : b + 1], camera(1)).occupancy
            if together.levels:
                found, expected = together.levels[0].logits[b], alone.levels[0].logits[0]
                assert torch.allclose(found, expected, atol=1e-4)
            if together.slots is not None and alone.slots is not None:
                assert torch.equal(together.slots.query_indices[b], alone.slots.query_indices[0])
                assert torch.allclose(
                    together.foreground_logits[b], alone.foreground_logits[0], atol=1e-3
                )


def test_the_grid_must_add_up() -> None:
    config = tiny_config()
    OmegaConf.resolve(config)
    config = config.model.occupancy_decoder
    for setting, value in (
        ("background.grid", [8, 8, 1]),
        ("background.kept", [100, 100]),
        ("objects.cells", 12),
    ):
        wrong = config.copy()
        OmegaConf.update(wrong, setting, value)
        with pytest.raises(InstantiationException, match=setting) as caught:
            instantiate(wrong)
        assert isinstance(caught.value.__cause__, InputError)


def test_paper_model_has_the_papers_parameters() -> None:
    with torch.device("meta"):
        model = instantiate(compose("train", ["model=paper", "model.backbone.weights=null"]).model)
    parameters = sum(p.numel() for p in model.parameters())
    assert abs(parameters / 51.11e6 - 1) < 0.05, parameters


def test_evaluation_selects_as_training_does_without_proposals() -> None:
    """Boxes of the selected tokens alone are those that training takes from the boxes of all."""
    model, batch = tiny_model().double(), small_batch(1)
    selection = model.detector.selection
    with torch.no_grad():
        selection.box_head[-1].weight.normal_(std=0.1)  # at first they are the ROIs
    memory = model.encode(normalize_images(batch.images).double())
    proposals, *trained = selection.train()(memory)
    nothing, *evaluated = selection.eval()(memory)
    for expected, found in zip(trained, evaluated, strict=True):
        assert torch.allclose(found, expected)
    selected, _, reference = trained
    assert not torch.allclose(reference, selection.rois[selected].double())
    assert proposals.pred_boxes.shape[1] == memory.tokens.shape[1]
    assert nothing is None


def test_evaluation_has_no_detection_loss() -> None:
    model, batch = tiny_model().eval(), small_batch(1)
    output = model.detect(model.encode(batch.images), batch.camera)
    with pytest.raises(ValueError, match="no proposals for the loss"):
        _ = output.supervised
