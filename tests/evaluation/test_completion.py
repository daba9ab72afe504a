"""Semantic scene completion against an independent implementation of the official evaluation."""

import doctest

import numpy as np
import pytest
import torch

from metric_factory import SMALL, random_grids
from occdetr.classes import CLASS_NAMES, LEARNING_MAP
from occdetr.data import semantickitti as kitti
from occdetr.data.frames import find_frames
from occdetr.evaluation import completion
from occdetr.evaluation.completion import SemanticSceneCompletion, confusion_matrix
from occdetr.evaluation.distance import BANDS, band_slices
from occdetr.files import write_image
from occdetr.geometry.kitti import write_calibration
from occdetr.geometry.voxels import GRID_SHAPE
from reference_completion import count_pairs, evaluate_folders, scores
from scene_factory import CAMERA


def assert_same_scores(found, expected):
    """Equal as floating-point numbers, without a tolerance."""
    assert [found["per_class"][name] for name in CLASS_NAMES[1:]] == expected["classes"]
    assert {key: found[key] for key in ("mIoU", "IoU", "precision", "recall")} == {
        key: expected[key] for key in ("mIoU", "IoU", "precision", "recall")
    }


@pytest.mark.parametrize("seed", range(20))
def test_scores_equal_the_reference_exactly(seed):
    prediction, target = random_grids(seed, num_classes=3 + seed % 18)
    metric = SemanticSceneCompletion()
    confusion = np.zeros((20, 20), dtype=np.int64)
    for frame in range(len(target)):
        metric.update(*(torch.from_numpy(grid[frame][None]) for grid in (prediction, target)))
        count_pairs(confusion, prediction[frame], target[frame], np.zeros(SMALL, dtype=np.uint8))
    assert metric.confusion.dtype == torch.int64
    np.testing.assert_array_equal(metric.confusion.numpy(), confusion)
    assert_same_scores(metric.compute(), scores(confusion))
    assert metric.compute()["num_frames"] == len(target)


def test_scores_equal_the_reference_on_files(tmp_path):
    rng = np.random.default_rng(7)
    metric = SemanticSceneCompletion()
    for name in ("000000", "000005", "000010"):
        raw = np.zeros(GRID_SHAPE, dtype=np.uint16)
        some = rng.random(GRID_SHAPE) < 0.02
        raw[some] = rng.choice(np.array(list(LEARNING_MAP)), some.sum())
        prefix = tmp_path / "sequences/08/voxels" / name
        kitti.write_raw_labels(prefix.with_suffix(".label"), raw)
        kitti.write_mask(prefix.with_suffix(".invalid"), rng.random(GRID_SHAPE) < 0.3)
        image = tmp_path / f"sequences/08/image_2/{name}.png"
        write_image(image, np.zeros((4, 4, 3), np.uint8))
    write_calibration(tmp_path / "sequences/08/calib.txt", CAMERA)
    for frame in find_frames(tmp_path, ["08"]):
        target = kitti.read_labels(frame)
        prediction = np.where(target == 255, 0, target)
        wrong = rng.random(GRID_SHAPE) < 0.01
        prediction[wrong] = rng.integers(0, 20, wrong.sum())
        folder = tmp_path / "out/sequences/08/predictions"
        kitti.write_labels(folder / f"{frame.name}.label", prediction)
        metric.update(torch.from_numpy(prediction[None]), torch.from_numpy(target[None]))
    assert_same_scores(metric.compute(), evaluate_folders(tmp_path, tmp_path / "out", ["08"]))


def test_mean_over_present_classes():
    target = torch.tensor([[0, 1, 1, 2, 2, 255]], dtype=torch.uint8).view(1, 6, 1, 1)
    prediction = torch.tensor([[0, 1, 1, 2, 3, 5]], dtype=torch.uint8).view(1, 6, 1, 1)
    metric = SemanticSceneCompletion()
    metric.update(prediction, target)
    found = metric.compute()
    assert found["mIoU_present"] == pytest.approx((1 + 0.5) / 2)
    assert found["mIoU"] == pytest.approx((1 + 0.5) / 19)
    assert found["IoU"] == 1.0
    assert found["recall"] == pytest.approx(1)  # approximately: of the official epsilon


def test_scores_without_evaluated_or_occupied_voxels_are_zero():
    metric = SemanticSceneCompletion()
    grid = torch.zeros(1, *SMALL, dtype=torch.uint8)
    metric.update(grid, torch.full_like(grid, 255))
    metric.update(grid, grid)
    found = metric.compute()
    assert [found[k] for k in ("mIoU", "mIoU_present", "IoU", "precision", "recall")] == [0.0] * 5


@pytest.mark.parametrize(("prediction", "target"), [(20, 0), (255, 3), (0, 20), (3, 254)])
def test_invalid_labels_raise(prediction, target):
    grids = [torch.full(SMALL, value, dtype=torch.uint8) for value in (prediction, target)]
    with pytest.raises(ValueError, match="0-19"):
        confusion_matrix(*grids)
    unknown = torch.full(SMALL, 255, dtype=torch.uint8)
    confusion_matrix(grids[0], unknown)  # any prediction is valid where nothing is evaluated


def test_different_shapes_raise():
    with pytest.raises((ValueError, TypeError), match=r"differ in shape|Type-check"):
        confusion_matrix(*(torch.zeros(n, 2, 2, dtype=torch.uint8) for n in (2, 3)))


# ----------------------------------------------------------------------------- by distance


def full_grids(shape=(2, *GRID_SHAPE), seed=0):
    generator = torch.Generator().manual_seed(seed)
    pair = [torch.randint(0, 21, shape, generator=generator, dtype=torch.uint8) for _ in range(2)]
    prediction, target = pair
    return prediction.clamp(max=19), target.masked_fill(target == 20, 255)


def test_bands_sum_to_the_whole_grid():
    prediction, target = full_grids()
    metric = SemanticSceneCompletion()
    metric.update(prediction, target)
    found = metric.compute()
    whole = confusion_matrix(prediction, target)
    assert torch.equal(torch.tensor(found["confusion"]).sum(0), whole)
    assert torch.equal(metric.confusion, whole)
    quarters = metric.bands.sum((1, 2)) / whole.sum()
    assert quarters.tolist() == pytest.approx([0.25, 0.25, 0.5], rel=0.01)


def test_scores_of_a_band_equal_those_of_a_grid_evaluated_there_only():
    prediction, target = full_grids(seed=1)
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


# ---------------------------------------------------------------------------------- example


def test_the_example_in_the_docstring():
    assert doctest.testmod(completion).attempted > 0
    assert doctest.testmod(completion).failed == 0
