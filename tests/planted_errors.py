"""Perfect predictions, and errors planted in them."""

from __future__ import annotations

import torch
from hydra.utils import instantiate
from torch import Tensor

from model_factory import tiny_config, tiny_model
from occdetr.evaluation.upper_bound import perfect_cells
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
)

CAR, TRUCK, PERSON, ROAD, VEGETATION = 1, 4, 6, 9, 15
AHEAD = 40  # first x index of the strip in which background errors are planted


def network(
    partition: str = "mixed", overrides: tuple[str, ...] = ()
) -> tuple[OccupancyDETR, OccupancyCriterion]:
    """A tiny network and the occupancy criterion of its configuration."""
    config = tiny_config(partition, overrides=overrides)
    return tiny_model(partition, overrides), instantiate(config.loss.occupancy)


def perfect(model: OccupancyDETR, batch: SceneBatch) -> SceneOutput:
    """The output of a perfect network for a batch of equal frames, with one unused slot."""
    assert batch.labels is not None
    assert batch.targets is not None
    target, labels, frames = batch.targets[0], batch.labels, len(batch)
    truth = SceneTruth.of_batch(batch).frame(0)
    count = len(target)
    boxes = model.slots.enlarge(target.boxes3d_grid)
    owner = truth.owner[0]
    cells = perfect_cells(model, truth, torch.arange(count), boxes).logit()
    side, slots = cells.shape[-1], count + 1
    query = torch.arange(slots).expand(frames, -1)
    unused = torch.full((1, side, side, side), -9.0)
    logits = torch.cat([cells, unused]).expand(frames, -1, -1, -1, -1).clone()
    boxes_cxcywh = torch.cat([target.boxes_cxcywh, torch.full((1, 4), 0.1)]).expand(frames, -1, -1)
    boxes3d = torch.cat([boxes, boxes.new_tensor([[30.0, 9, 0, 2, 2, 2]])]).expand(frames, -1, -1)
    classes = torch.cat([target.classes, torch.tensor([PERSON])]).expand(frames, -1)
    scores = torch.tensor([0.9] * count + [0.0]).expand(frames, -1)
    background = labels[0].masked_fill((owner > 0) | (labels[0] == 255), 0)
    in_strip = torch.zeros_like(background, dtype=torch.bool)
    in_strip[AHEAD : AHEAD + 4] = True  # empty voxels are candidates here
    coordinates = ((background > 0) | in_strip).nonzero()
    true = background[tuple(coordinates.T)]
    masks = 20.0 * (model.fusion.mask_classes[:, None] == true.clamp(min=1))
    filled = torch.where(true > 0, 9.0, -9.0).expand(frames, -1).clone()
    voxels = BackgroundLevel(coordinates.expand(frames, -1, -1), filled, 1)
    layer = LayerDetections(
        torch.zeros(frames, slots, 10), boxes_cxcywh.clone(), torch.zeros_like(boxes3d)
    )
    proposals = Proposals(torch.zeros(frames, 1, 10), torch.zeros(frames, 1, 4))
    detections = DetectorOutput(torch.zeros(frames, slots, 1), [layer], proposals, query)
    occupancy = OccupancyOutput(
        Slots(query, scores.clone(), classes.clone(), boxes3d.clone(), scores > 0),
        logits, [], voxels, masks.expand(frames, -1, -1).clone(),
    )  # fmt: skip
    return SceneOutput(detections, occupancy)


def miss_the_car(occupancy: OccupancyOutput) -> None:
    occupancy.slots.scores[:, 0] = 0.1


def call_the_car_a_truck(occupancy: OccupancyOutput) -> None:
    occupancy.slots.classes[:, 0] = TRUCK


def invent_a_person(occupancy: OccupancyOutput) -> None:
    occupancy.slots.scores[:, -1] = 0.8
    occupancy.foreground_logits[:, -1] = 9.0


def shift_the_car(occupancy: OccupancyOutput) -> None:
    occupancy.slots.boxes3d[:, 0, 0] += 12.0


def halve_the_car(occupancy: OccupancyOutput) -> None:
    occupancy.foreground_logits[:, 0, :18] = -9.0


def strip(occupancy: OccupancyOutput, class_id: int) -> Tensor:
    """Which candidates of a class are in the strip."""
    x = occupancy.voxels.coordinates[0, :, 0]
    return (occupancy.mask_logits[0, class_id - 1] > 0) & (x >= AHEAD) & (x < AHEAD + 4)


def dig_a_hole(occupancy: OccupancyOutput) -> None:
    occupancy.voxels.logits[:, strip(occupancy, ROAD)] = -9.0


def drop_candidates(occupancy: OccupancyOutput) -> None:
    kept = ~strip(occupancy, VEGETATION)
    occupancy.voxels = BackgroundLevel(
        occupancy.voxels.coordinates[:, kept],
        occupancy.voxels.logits[:, kept],
        occupancy.voxels.cell,
    )
    occupancy.mask_logits = occupancy.mask_logits[:, :, kept]


def fill_the_air(occupancy: OccupancyOutput) -> None:
    x = occupancy.voxels.coordinates[0, :, 0]
    empty = (occupancy.voxels.logits[0] < 0) & (x == AHEAD)
    occupancy.voxels.logits[:, empty] = 9.0


def mistake_the_road(occupancy: OccupancyOutput) -> None:
    selected = strip(occupancy, ROAD) & (occupancy.voxels.logits[0] > 0)
    occupancy.mask_logits[:, VEGETATION - 1, selected] = 40.0


#: The part of the prediction that each error is in.
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


def untrained(partition: str) -> tuple[OccupancyDETR, OccupancyCriterion]:
    """An untrained network whose fusion writes all slots."""
    model, criterion = network(partition, ("model.slots.num_slots=5",))
    model.eval()
    model.fusion.score_threshold = 0.0
    model.fusion.background_threshold = 0.5
    return model, criterion
