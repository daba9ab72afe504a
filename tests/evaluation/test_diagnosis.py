"""Planted errors: the truth for the part at fault corrects them, and no other does."""

from __future__ import annotations

import pytest
import torch
from hydra.utils import instantiate
from torch import Tensor

from model_factory import small_batch, tiny_config, tiny_model
from occdetr.evaluation.completion import SemanticSceneCompletion
from occdetr.evaluation.diagnosis import Diagnosis
from occdetr.evaluation.object_errors import Written, match_objects
from occdetr.evaluation.substitution import PREDICTION_PARTS, SubstitutedFrame
from occdetr.evaluation.upper_bound import LIMITS, UpperBound, perfect_cells
from occdetr.geometry.boxes import enlarge_boxes3d
from occdetr.losses.occupancy import OccupancyCriterion
from occdetr.losses.targets import SceneTruth
from occdetr.models.occdetr import OccupancyDETR
from occdetr.structures import (
    BackgroundLevel,
    DetectorOutput,
    LayerDetections,
    OccupancyOutput,
    Proposals,
    SceneBatch,
    SceneOutput,
    Slots,
    empty_target,
)

CAR, TRUCK, PERSON, ROAD, VEGETATION = 1, 4, 6, 9, 15
AHEAD = 40  # voxels of the background that errors are planted in lie this far ahead


def network(
    partition: str = "mixed", overrides: tuple[str, ...] = ()
) -> tuple[OccupancyDETR, OccupancyCriterion]:
    config = tiny_config(partition, overrides=overrides)
    return tiny_model(partition, overrides), instantiate(config.loss.occupancy)


def perfect(model: OccupancyDETR, batch: SceneBatch) -> SceneOutput:
    """The output of a perfect network for frames that are all alike."""
    assert batch.labels is not None
    assert batch.targets is not None
    target, labels, frames = batch.targets[0], batch.labels, len(batch)
    truth = SceneTruth.of_batch(batch).frame(0)
    count = len(target)
    boxes = model.slots.enlarge(target.boxes3d_grid)
    owner = truth.owner[0]
    cells = perfect_cells(model, truth, torch.arange(count), boxes).logit()
    side, slots = cells.shape[-1], count + 1  # one is not used
    query = torch.arange(slots).expand(frames, -1)
    unused = torch.full((1, side, side, side), -9.0)
    logits = torch.cat([cells, unused]).expand(frames, -1, -1, -1, -1).clone()
    plane = torch.cat([target.boxes_cxcywh, torch.full((1, 4), 0.1)]).expand(frames, -1, -1)
    space = torch.cat([boxes, boxes.new_tensor([[30.0, 9, 0, 2, 2, 2]])]).expand(frames, -1, -1)
    classes = torch.cat([target.classes, torch.tensor([PERSON])]).expand(frames, -1)
    scores = torch.tensor([0.9] * count + [0.0]).expand(frames, -1)
    answered = labels[0].masked_fill((owner > 0) | (labels[0] == 255), 0)
    around = torch.zeros_like(answered, dtype=torch.bool)
    around[AHEAD : AHEAD + 4] = True  # candidates that are empty
    coordinates = ((answered > 0) | around).nonzero()
    true = answered[tuple(coordinates.T)]
    masks = (model.fusion.mask_classes[:, None] == true.clamp(min=1)).float()
    filled = torch.where(true > 0, 9.0, -9.0).expand(frames, -1).clone()
    voxels = BackgroundLevel(coordinates.expand(frames, -1, -1), filled, 1)
    layer = LayerDetections(torch.zeros(frames, slots, 10), plane.clone(), torch.zeros_like(space))
    proposals = Proposals(torch.zeros(frames, 1, 10), torch.zeros(frames, 1, 4))
    detections = DetectorOutput(torch.zeros(frames, slots, 1), [layer], proposals, query)
    occupancy = OccupancyOutput(
        Slots(query, scores.clone(), classes.clone(), space.clone(), scores > 0),
        logits, [], voxels, masks.expand(frames, -1, -1).clone(),
    )  # fmt: skip
    return SceneOutput(detections, occupancy)


# ------------------------------------------------------------------------- planted errors


def miss_the_car(said: OccupancyOutput) -> None:
    said.slots.scores[:, 0] = 0.1


def call_the_car_a_truck(said: OccupancyOutput) -> None:
    said.slots.classes[:, 0] = TRUCK


def invent_a_person(said: OccupancyOutput) -> None:
    said.slots.scores[:, -1] = 0.8
    said.foreground_logits[:, -1] = 9.0


def shift_the_car(said: OccupancyOutput) -> None:
    said.slots.boxes3d[:, 0, 0] += 12.0


def halve_the_car(said: OccupancyOutput) -> None:
    said.foreground_logits[:, 0, :18] = -9.0


def strip(said: OccupancyOutput, kind: int) -> Tensor:
    """Candidates of a class within a strip of the scene."""
    x = said.voxels.coordinates[0, :, 0]
    return (said.mask_logits[0, kind - 1] > 0) & (x >= AHEAD) & (x < AHEAD + 4)


def dig_a_hole(said: OccupancyOutput) -> None:
    said.voxels.logits[:, strip(said, ROAD)] = -9.0


def drop_candidates(said: OccupancyOutput) -> None:
    kept = ~strip(said, VEGETATION)
    said.voxels = BackgroundLevel(
        said.voxels.coordinates[:, kept], said.voxels.logits[:, kept], said.voxels.cell
    )
    said.mask_logits = said.mask_logits[:, :, kept]


def fill_the_air(said: OccupancyOutput) -> None:
    x = said.voxels.coordinates[0, :, 0]
    empty = (said.voxels.logits[0] < 0) & (x == AHEAD)
    said.voxels.logits[:, empty] = 9.0


def mistake_the_road(said: OccupancyOutput) -> None:
    those = strip(said, ROAD) & (said.voxels.logits[0] > 0)
    said.mask_logits[:, VEGETATION - 1, those] = 5.0


PLANTED = {
    miss_the_car: "detections",
    call_the_car_a_truck: "detections",
    invent_a_person: "detections",
    shift_the_car: "3D boxes",
    halve_the_car: "object occupancy",
    dig_a_hole: "background occupancy",
    drop_candidates: "background occupancy",
    fill_the_air: "background occupancy",
    mistake_the_road: "background classes",
}


@pytest.fixture(scope="module")
def scene() -> tuple[OccupancyDETR, OccupancyCriterion, SceneBatch, Tensor]:
    # enough for the whole background
    enough = ("model.occupancy_decoder.background.kept=[2048,6144,24576]",)
    model, criterion = network("mixed", enough)
    batch = small_batch(2)
    assert batch.labels is not None
    assert batch.targets is not None
    bound = UpperBound(model, criterion)
    grid = bound.perfect_grid(SceneTruth.of_batch(batch).frame(0), LIMITS)
    return model, criterion, batch, grid


def test_a_perfect_prediction_stays_perfect(scene) -> None:
    model, criterion, batch, best = scene
    output = perfect(model, batch)
    assert torch.equal(model.fusion(output.occupancy), best.expand(2, -1, -1, -1))
    frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, 1)
    for parts in ([], *[[part] for part in PREDICTION_PARTS], PREDICTION_PARTS):
        assert torch.equal(frame.fuse(parts), best), parts


@pytest.mark.parametrize(
    ("plant", "part"), PLANTED.items(), ids=lambda v: getattr(v, "__name__", "")
)
def test_the_truth_for_the_part_at_fault_corrects_an_error_and_no_other(plant, part, scene) -> None:
    model, criterion, batch, best = scene
    output = perfect(model, batch)
    plant(output.occupancy)
    spoilt = model.fusion(output.occupancy)
    frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, 0)
    assert torch.equal(frame.fuse([]), spoilt[:1])
    assert not torch.equal(spoilt[:1], best)
    assert torch.equal(frame.fuse([part]), best)
    assert torch.equal(frame.fuse(PREDICTION_PARTS), best)
    for other in set(PREDICTION_PARTS) - {part}:
        found = frame.fuse([other])
        if (plant, other) == (shift_the_car, "object occupancy"):
            # no cell of the box that it has is the car's: it is gone, but does not come back
            assert (found[best == CAR] != CAR).all()
            continue
        assert torch.equal(found, spoilt[:1]), other
    diagnosis = Diagnosis(model, criterion)
    diagnosis.update(model, batch, output, spoilt)
    results = diagnosis.compute()
    assert results["num_frames"] == 2
    assert results["advice"].startswith(f"Work on the {part}: ")
    together = [scores["mIoU"] for scores in results["together"].values()]
    assert together[-1] == pytest.approx(completion(batch, best))
    assert results["as_predicted"]["mIoU"] < together[-1]


def completion(batch: SceneBatch, best: Tensor) -> float:
    metric = SemanticSceneCompletion()
    assert batch.labels is not None
    metric.update(best.expand(2, -1, -1, -1), batch.labels)
    return metric.compute()["mIoU"]


@pytest.mark.parametrize(
    ("plant", "outcome"),
    [
        (miss_the_car, "missed"),
        (call_the_car_a_truck, "wrong class"),
        (shift_the_car, "wrong place"),
        (halve_the_car, "wrong shape"),
        (dig_a_hole, "right"),
    ],
)
def test_objects_and_their_voxels_by_outcome(plant, outcome, scene) -> None:
    model, criterion, batch, _ = scene
    output = perfect(model, batch)
    plant(output.occupancy)
    diagnosis = Diagnosis(model, criterion)
    diagnosis.update(model, batch, output, model.fusion(output.occupancy))
    results = diagnosis.compute()
    of_car, of_pole = results["objects"]["car"], results["objects"]["pole"]
    assert {key: n for key, n in of_car.items() if n} == {outcome: 2}  # in two frames
    assert {key: n for key, n in of_pole.items() if n} == {"right": 2}
    number = int((batch.labels == CAR).sum())
    lost = {key: n for key, n in results["lost"].get("car", {}).items() if n}
    if outcome in ("missed", "wrong class", "wrong place"):
        assert lost == {outcome: number}
    if outcome == "wrong shape":
        assert 0.3 * number < lost[outcome] < 0.7 * number
    if outcome == "wrong class":
        assert results["invented"]["truck"]["wrong class"] > 0.8 * number
    if outcome == "wrong place":
        assert results["invented"]["car"]["wrong place"] > 0.8 * number


def test_false_detections_and_background_are_told_apart(scene) -> None:
    model, criterion, batch, _ = scene
    output = perfect(model, batch)
    invent_a_person(output.occupancy)
    output.occupancy.mask_logits[:, TRUCK - 1, strip(output.occupancy, ROAD)] = 5.0
    diagnosis = Diagnosis(model, criterion)
    diagnosis.update(model, batch, output, model.fusion(output.occupancy))
    results = diagnosis.compute()
    assert results["objects"]["person"]["false"] == 2
    assert {key for key, n in results["invented"]["person"].items() if n} == {"false"}
    assert {key for key, n in results["invented"]["truck"].items() if n} == {"background"}
    assert results["invented"]["truck"]["background"] == 2 * 4 * 50  # frames, x, y


# ----------------------------------------------------------------- a network that knows nothing


def guessing(partition: str) -> tuple[OccupancyDETR, OccupancyCriterion]:
    """A network fresh from its initialisation that writes all of its slots."""
    model, criterion = network(partition, ("model.slots.num_slots=5",))
    model.eval()
    model.fusion.score_threshold = 0.0
    model.fusion.background_threshold = 0.5
    return model, criterion


@pytest.mark.parametrize("partition", ["mixed", "all_foreground", "all_background"])
def test_with_every_part_true_the_score_is_the_upper_bound(partition: str) -> None:
    batch = small_batch(2, objects=partition != "all_background")
    assert batch.labels is not None
    assert batch.targets is not None
    batch.labels[1, 60:70, 20:30, 5:9] = 255
    model, criterion = guessing(partition)
    output, grids = model.predict(batch)
    bound, diagnosis = UpperBound(model, criterion), Diagnosis(model, criterion)
    truth = SceneTruth.of_batch(batch)
    for index in range(2):
        frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, index)
        assert torch.equal(frame.fuse([])[0], grids[index])
        best = bound.perfect_grid(truth.frame(index), LIMITS)
        assert torch.equal(frame.fuse(diagnosis.parts), best)
    parts = list(PREDICTION_PARTS)
    expected = {"mixed": parts, "all_foreground": parts[:3], "all_background": parts[3:]}
    assert diagnosis.parts == expected[partition]
    bound.update(batch)
    diagnosis.update(model, batch, output, grids)
    results, expected = diagnosis.compute(), bound.results()["all"]
    last = results["together"][diagnosis.parts[-1]]
    assert last == {key: expected[key] for key in last}
    assert bool(results["objects"]) == (partition != "all_background")


def test_wrong_voxels_are_counted_without_a_rest() -> None:
    batch = small_batch(2)
    assert batch.labels is not None
    batch.labels[:, 200:204, 10:20, 5] = CAR  # of no object
    model, criterion = guessing("mixed")
    output, grids = model.predict(batch)
    diagnosis, whole = Diagnosis(model, criterion), SemanticSceneCompletion()
    diagnosis.update(model, batch, output, grids)
    whole.update(grids, batch.labels)
    right = whole.confusion.diagonal()
    foreground = model.foreground_classes
    lost = (whole.confusion.sum(0) - right)[foreground]
    invented = (whole.confusion.sum(1) - right)[foreground]
    assert lost.sum() > 0
    assert invented.sum() > 0
    assert torch.equal(diagnosis.errors.lost.sum(1)[foreground], lost)
    assert torch.equal(diagnosis.errors.invented.sum(1)[foreground], invented)
    assert diagnosis.compute()["lost"]["car"]["background"] == 2 * 40
    true_objects = diagnosis.errors.objects[:, :-1].sum()
    assert true_objects == 2 * 2


def test_a_frame_without_objects() -> None:
    batch = small_batch(2)
    assert batch.targets is not None
    batch.targets[1] = empty_target()
    model, criterion = guessing("mixed")
    output, grids = model.predict(batch)
    frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, 1)
    truth = SceneTruth.of_batch(batch).frame(1)
    best = UpperBound(model, criterion).perfect_grid(truth, LIMITS)
    assert torch.equal(frame.fuse(PREDICTION_PARTS), best)
    diagnosis = Diagnosis(model, criterion)
    diagnosis.update(model, batch, output, grids)
    false = sum(outcomes["false"] for outcomes in diagnosis.compute()["objects"].values())
    assert 5 <= false <= 10  # five slots a frame, two of them at most matched in the first
    model.fusion.score_threshold = 1.0  # nor any detection
    grids = model.fusion(output.occupancy)
    frame = SubstitutedFrame(model, criterion, SceneTruth.of_batch(batch), output, 1)
    assert torch.equal(frame.fuse([])[0], grids[1])
    assert torch.equal(frame.fuse(PREDICTION_PARTS), best)


def test_nothing_to_gain_is_said(scene) -> None:
    model, criterion, batch, best = scene
    diagnosis = Diagnosis(model, criterion)
    output = perfect(model, batch)
    diagnosis.update(model, batch, output, best.expand(2, -1, -1, -1))
    assert diagnosis.compute()["advice"].startswith("No part alone")
    diagnosis.reset()
    assert diagnosis.errors.objects.sum() == 0
    assert all(int(metric.num_frames) == 0 for metric in diagnosis.completion)


# ------------------------------------------------------------------------------- matching


def match(shift: float, plane_shift: float = 0.0, classes: tuple[int, ...] = (1, 18)) -> list[int]:
    target = small_batch(1).targets[0]
    boxes = enlarge_boxes3d(target.boxes3d_grid, 1.5, 1.6)
    moved, plane = boxes.clone(), target.boxes_cxcywh.clone()
    moved[:, 1] += shift
    plane[:, 0] += plane_shift
    return match_objects(torch.tensor(classes), plane, moved, target, boxes).tolist()


def test_objects_match_in_the_image_or_in_space() -> None:
    assert match(0.0) == [0, 1]
    assert match(5.0) == [0, 1]  # as in the image
    assert match(0.5, plane_shift=0.3) == [0, 1]  # as in space, by enlarged boxes
    assert match(5.0, plane_shift=0.3) == [-1, -1]
    assert match(0.0, classes=(4, 6)) == [0, 1]  # whatever the class


def test_of_two_detections_of_an_object_one_is_false() -> None:
    target = small_batch(1).targets[0]
    boxes = enlarge_boxes3d(target.boxes3d_grid, 1.5, 1.6)[[0, 0]]
    plane = target.boxes_cxcywh[[0, 0]]
    every = enlarge_boxes3d(target.boxes3d_grid, 1.5, 1.6)
    found = match_objects(torch.tensor([TRUCK, CAR]), plane, boxes, target, every)
    assert found.tolist() == [-1, 0]  # the one of its class
    written = Written(torch.tensor([TRUCK, CAR]), boxes, torch.zeros(2, 1, 1, 1), found)
    assert written.of_objects(2).tolist() == [1, -1]
