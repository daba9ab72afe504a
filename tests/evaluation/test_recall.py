"""Bands of distance: they divide what is counted without a rest."""

import numpy as np
import pytest
import torch

from occdetr.evaluation.completion import DetectionMetric, SemanticSceneCompletion, confusion_matrix
from occdetr.evaluation.recall import BANDS, DetectionRecall, band_of, band_slices
from occdetr.geometry.boxes import cxcywh_to_xyxy
from occdetr.geometry.voxels import GRID_SHAPE, voxel_centers
from occdetr.structures import SceneTarget


def random_grids(shape=(2, *GRID_SHAPE), seed=0):
    generator = torch.Generator().manual_seed(seed)
    pair = [torch.randint(0, 21, shape, generator=generator, dtype=torch.uint8) for _ in range(2)]
    prediction, target = pair
    return prediction.clamp(max=19), target.masked_fill(target == 20, 255)


def test_bands_hold_the_voxels_whose_centres_they_name():
    x = voxel_centers(np.stack([np.arange(256), *np.zeros((2, 256), int)], axis=1))[:, 0]
    bands = band_of(torch.from_numpy(x))
    expected = np.digitize(x, [12.8, 25.6])
    np.testing.assert_array_equal(bands.numpy(), expected)
    for number, part in enumerate(band_slices()):
        np.testing.assert_array_equal(np.arange(256)[part], np.flatnonzero(expected == number))


def test_the_bands_sum_to_the_whole():
    prediction, target = random_grids()
    metric = SemanticSceneCompletion()
    metric.update(prediction, target)
    found = metric.compute()
    whole = confusion_matrix(prediction, target)
    assert torch.equal(torch.tensor(found["confusion"]).sum(0), whole)
    assert torch.equal(metric.confusion, whole)
    quarters = metric.bands.sum((1, 2)) / whole.sum()
    assert quarters.tolist() == pytest.approx([0.25, 0.25, 0.5], rel=0.01)


def test_a_band_scores_as_a_grid_of_its_own():
    prediction, target = random_grids(seed=1)
    prediction = torch.where(torch.rand(prediction.shape) < 0.5, target % 20, prediction)
    whole = SemanticSceneCompletion()
    whole.update(prediction, target)
    by_distance = whole.compute()["by_distance"]
    assert tuple(by_distance) == BANDS
    for name, part in zip(BANDS, band_slices(), strict=True):
        alone = SemanticSceneCompletion()
        padded = torch.full_like(target, 255)
        padded[:, part] = target[:, part]
        alone.update(prediction, padded)
        expected = alone.compute()
        assert by_distance[name] == {key: expected[key] for key in by_distance[name]}


def a_target(places, classes):
    """Objects of 2 m, x metres ahead; in the image side by side, each 0.1 wide."""
    count = len(places)
    across = (torch.arange(count) + 0.5) / 10
    x, ones = torch.tensor(places, dtype=torch.float32), torch.ones(count)
    return SceneTarget(
        classes=torch.tensor(classes, dtype=torch.long),
        boxes_cxcywh=torch.stack([across, 0.5 * ones, 0.1 * ones, 0.2 * ones], 1),
        boxes3d_camera=torch.stack([0 * ones, 0 * ones, x, *[2 * ones] * 3], 1),
        boxes3d_grid=torch.stack([x, 0 * ones, 0 * ones, *[2 * ones] * 3], 1),
        voxels=torch.zeros(0, 3, dtype=torch.int16),
        voxel_object=torch.zeros(0, dtype=torch.long),
        visible_fraction=ones,
        roi_indices=torch.arange(count),
    )


def detect(metric, target, scores, classes=None, aside=0.0, away=0.0):
    """Detections of all objects, their boxes shifted: ``aside`` in the image, ``away`` in space."""
    classes = target.classes if classes is None else classes
    plane, space = target.boxes_cxcywh.clone(), target.boxes3d_camera.clone()
    plane[:, 0] += aside
    space[:, 2] += away
    metric.update(
        *(torch.tensor([0]), torch.tensor([scores], dtype=torch.float32), classes[None]),
        *(cxcywh_to_xyxy(plane)[None], space[None], [target]),
    )


def test_recall_counts_objects_where_they_are():
    target = a_target([5.0, 12.7, 12.8, 30.0, 31.0], [1, 6, 1, 1, 18])
    metric = DetectionRecall(score_threshold=0.3)
    detect(metric, target, [0.9, 0.2, 0.9, 0.9, 0.9], away=0.5)  # the second is not sure enough
    detect(metric, target, [0.9] * 5, aside=0.04, away=1.3)  # IoU 0.43 and 0.21
    found = metric.compute()
    assert list(found) == ["car", "person", "pole"]
    counts = {name: [tuple(found[name][band].values()) for band in BANDS] for name in found}
    assert counts == {
        "car": [(2, 1, 1), (2, 1, 1), (2, 1, 1)],
        "person": [(2, 0, 0), (0, 0, 0), (0, 0, 0)],
        "pole": [(0, 0, 0), (0, 0, 0), (2, 1, 1)],
    }
    assert metric.counts.dtype == torch.int64


def test_recall_in_2d_and_in_3d_are_apart_and_ask_for_the_class():
    target = a_target([5.0, 20.0], [1, 6])
    for shifts, classes, expected in (
        ({"aside": 0.04}, None, (0, 1)),
        ({"away": 1.3}, None, (1, 0)),
        ({}, torch.tensor([1, 7]), (1, 1)),
    ):
        metric = DetectionRecall()
        detect(metric, target, [0.9, 0.9], classes, **shifts)
        found = metric.compute()
        first = found["car"][BANDS[0]]
        assert (first["found2d_50"], first["found3d_25"]) == expected
        person = found["person"][BANDS[1]]
        assert person["found2d_50"] == (0 if classes is not None else expected[0])


@pytest.mark.parametrize("away", [0.0, 1.1, 1.3])
def test_recall_over_all_classes_and_bands_is_the_one_figure(away):
    target = a_target([5.0, 20.0, 40.0], [1, 1, 18])
    one, many = DetectionMetric(), DetectionRecall()
    for metric in (one, many):
        detect(metric, target, [0.9, 0.1, 0.9], away=away)
    objects, _, in_space = many.counts.sum((1, 2)).tolist()
    assert objects == 3
    assert one.compute()["recall3d_25"] == pytest.approx(in_space / objects)


def test_no_objects_no_recall():
    metric = DetectionRecall()
    target = a_target([], [])
    detect(metric, target, [])
    assert metric.compute() == {}
