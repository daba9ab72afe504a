from datetime import timedelta

import numpy as np
import pytest
import torch
from torch.multiprocessing.spawn import spawn

from occdetr.classes import CLASS_NAMES, LEARNING_MAP
from occdetr.data import semantickitti as kitti
from occdetr.data.frames import find_frames
from occdetr.evaluation.completion import DetectionMetric, SemanticSceneCompletion, confusion_matrix
from occdetr.evaluation.evaluator import SceneEvaluator
from occdetr.evaluation.position_baseline import PositionBaseline
from occdetr.geometry.voxels import GRID_SHAPE
from occdetr.structures import empty_target
from reference_completion import count_pairs, evaluate_folders, scores

SMALL = (12, 10, 8)


def random_grids(seed, frames=3, shape=SMALL, num_classes=20):
    """Mostly empty predictions and targets with some rare classes, and 255 in the target."""
    rng = np.random.default_rng(seed)
    shares = np.concatenate([[3.0], rng.random(num_classes - 1) ** 4])
    shares /= shares.sum()
    target = rng.choice(num_classes, (frames, *shape), p=shares).astype(np.uint8)
    guess = rng.choice(num_classes, target.shape, p=shares).astype(np.uint8)
    prediction = np.where(rng.random(target.shape) < 0.6, target, guess)
    target[rng.random(target.shape) < 0.25] = 255
    return prediction, target


def assert_same_scores(found, expected):
    """Equal to the last digit."""
    assert [found["per_class"][name] for name in CLASS_NAMES[1:]] == expected["classes"]
    assert {key: found[key] for key in ("mIoU", "IoU", "precision", "recall")} == {
        key: expected[key] for key in ("mIoU", "IoU", "precision", "recall")
    }


# ---------------------------------------------------------------------------- completion


@pytest.mark.parametrize("seed", range(20))
def test_completion_equals_the_reference_exactly(seed):
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


def test_completion_equals_the_reference_from_files(tmp_path):
    rng = np.random.default_rng(7)
    metric = SemanticSceneCompletion()
    for name in ("000000", "000005", "000010"):
        raw = np.zeros(GRID_SHAPE, dtype=np.uint16)
        some = rng.random(GRID_SHAPE) < 0.02
        raw[some] = rng.choice(np.array(list(LEARNING_MAP)), some.sum())
        prefix = tmp_path / "sequences/08/voxels" / name
        kitti.write_raw_labels(prefix.with_suffix(".label"), raw)
        kitti.write_mask(prefix.with_suffix(".invalid"), rng.random(GRID_SHAPE) < 0.3)
        kitti.write_image(
            tmp_path / f"sequences/08/image_2/{name}.png", np.zeros((4, 4, 3), np.uint8)
        )
    kitti.write_calibration(
        tmp_path / "sequences/08/calib.txt", kitti.Calibration(np.eye(3, 4), np.eye(4))
    )
    for frame in find_frames(tmp_path, ["08"]):
        target = kitti.read_labels(frame)
        prediction = np.where(target == 255, 0, target)
        wrong = rng.random(GRID_SHAPE) < 0.01
        prediction[wrong] = rng.integers(0, 20, wrong.sum())
        folder = tmp_path / "out/sequences/08/predictions"
        kitti.write_labels(folder / f"{frame.name}.label", prediction)
        metric.update(torch.from_numpy(prediction[None]), torch.from_numpy(target[None]))
    assert_same_scores(metric.compute(), evaluate_folders(tmp_path, tmp_path / "out", ["08"]))


def test_present_classes_have_their_own_mean():
    target = torch.tensor([[0, 1, 1, 2, 2, 255]], dtype=torch.uint8).view(1, 6, 1, 1)
    prediction = torch.tensor([[0, 1, 1, 2, 3, 5]], dtype=torch.uint8).view(1, 6, 1, 1)
    metric = SemanticSceneCompletion()
    metric.update(prediction, target)
    found = metric.compute()
    assert found["mIoU_present"] == pytest.approx((1 + 0.5) / 2)
    assert found["mIoU"] == pytest.approx((1 + 0.5) / 19)
    assert found["IoU"] == 1.0
    assert found["recall"] == pytest.approx(1)  # the official one, with its epsilon


def test_nothing_to_evaluate_is_zero_everywhere():
    metric = SemanticSceneCompletion()
    grid = torch.zeros(1, *SMALL, dtype=torch.uint8)
    metric.update(grid, torch.full_like(grid, 255))
    metric.update(grid, grid)
    found = metric.compute()
    assert [found[k] for k in ("mIoU", "mIoU_present", "IoU", "precision", "recall")] == [0.0] * 5


@pytest.mark.parametrize(("prediction", "target"), [(20, 0), (255, 3), (0, 20), (3, 254)])
def test_values_that_are_no_class_are_refused(prediction, target):
    grids = [torch.full(SMALL, value, dtype=torch.uint8) for value in (prediction, target)]
    with pytest.raises(ValueError, match="0-19"):
        confusion_matrix(*grids)
    confusion_matrix(
        grids[0], torch.full(SMALL, 255, dtype=torch.uint8)
    )  # not evaluated: no matter


def test_shapes_must_agree():
    with pytest.raises((ValueError, TypeError), match=r"differ in shape|Type-check"):
        confusion_matrix(*(torch.zeros(n, 2, 2, dtype=torch.uint8) for n in (2, 3)))


# ---------------------------------------------------------------------------- detection


def boxes_target(classes, boxes_cxcywh, boxes3d=None):
    target = empty_target()
    target.classes = torch.tensor(classes, dtype=torch.long)
    target.boxes_cxcywh = torch.tensor(boxes_cxcywh).view(-1, 4)
    target.boxes3d_camera = boxes3d if boxes3d is not None else torch.ones(len(classes), 6)
    x_y_z = [2, 0, 1]  # ahead, left and up are a camera's z, x and y, but for the signs
    target.boxes3d_grid = target.boxes3d_camera.unflatten(1, (2, 3))[:, :, x_y_z].flatten(1)
    return target


def as_xyxy(boxes):
    return torch.cat([boxes[..., :2] - boxes[..., 2:] / 2, boxes[..., :2] + boxes[..., 2:] / 2], -1)


def random_frame(seed):
    """A target of 0-4 objects and 12 detections, some of them near an object."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    count = seed % 5
    target = boxes_target(
        torch.randint(1, 4, (count,), generator=generator).tolist(),
        torch.cat([0.2 + 0.6 * uniform(count, 2), 0.1 + 0.2 * uniform(count, 2)], 1).tolist(),
        torch.cat([10 * uniform(count, 3), 1 + uniform(count, 3)], 1),
    )
    classes = torch.randint(1, 5, (12,), generator=generator)
    boxes = torch.cat([0.2 + 0.6 * uniform(12, 2), 0.1 + 0.2 * uniform(12, 2)], 1)
    boxes3d = torch.cat([10 * uniform(12, 3), 1 + uniform(12, 3)], 1)
    for i in range(2 * count):  # two near each object
        classes[i] = target.classes[i // 2]
        boxes[i] = target.boxes_cxcywh[i // 2] + 0.03 * (uniform(4) - 0.5)
        boxes3d[i] = target.boxes3d_camera[i // 2] + 0.5 * (uniform(6) - 0.5)
    return uniform(12), classes, as_xyxy(boxes), boxes3d, target


def update(metric, frames):
    """One batch of several frames, given by their seeds, which are their indices too."""
    parts = list(zip(*(random_frame(index) for index in frames), strict=True))
    scores_, classes, boxes, boxes3d = (torch.stack(part) for part in parts[:4])
    metric.update(torch.tensor(frames), scores_, classes, boxes, boxes3d, list(parts[4]))


def iou_2d(a, b):
    inner = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    both = np.prod(np.maximum(inner, 0))
    return both / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - both)


def reference_ap(frames, category, threshold):
    """COCO's interpolated AP of one class, slowly; None for a class without objects."""
    hits, total = [], 0
    for index in frames:
        scores_, classes, boxes, _, target = random_frame(index)
        truth = as_xyxy(target.boxes_cxcywh)[target.classes == category].double().numpy()
        free = [True] * len(truth)
        total += len(truth)
        for i in torch.argsort(-scores_).tolist():
            if classes[i] != category:
                continue
            best, chosen = threshold, None
            for j, box in enumerate(truth):
                overlap = iou_2d(boxes[i].double().numpy(), box)
                if free[j] and overlap >= best:
                    best, chosen = overlap, j
            if chosen is not None:
                free[chosen] = False
            hits.append((float(scores_[i]), chosen is not None))
    if not total:
        return None
    found = np.array([hit for _, hit in sorted(hits, key=lambda pair: -pair[0])], dtype=float)
    recall = np.cumsum(found) / total
    precision = np.cumsum(found) / np.arange(1, len(found) + 1)
    points = np.linspace(0, 1, 101)
    return np.mean([max(precision[recall >= point - 1e-12], default=0.0) for point in points])


def test_average_precision_equals_a_slow_reference():
    frames = list(range(12))
    metric = DetectionMetric(image_size=(370, 1220))
    update(metric, frames[:5])
    update(metric, frames[5:])
    found = metric.compute()
    by_threshold = [
        np.mean([ap for c in range(1, 5) if (ap := reference_ap(frames, c, t)) is not None])
        for t in np.linspace(0.5, 0.95, 10)
    ]
    assert 0.2 < by_threshold[0] < 1
    assert found["AP50"] == pytest.approx(by_threshold[0], abs=1e-9)
    assert found["mAP"] == pytest.approx(np.mean(by_threshold), abs=1e-9)


def test_perfect_detections_score_one():
    target = random_frame(4)[4]
    metric = DetectionMetric()
    metric.update(
        torch.tensor([0]),
        torch.full((1, 4), 0.9),
        target.classes[None],
        as_xyxy(target.boxes_cxcywh)[None],
        target.boxes3d_camera[None],
        [target],
    )
    assert metric.compute() == {"mAP": 1.0, "AP50": 1.0, "recall3d_25": 1.0}


def test_frames_without_objects_make_detections_false():
    def ap50(*extra):
        metric = DetectionMetric()
        update(metric, [4, *extra])
        return metric.compute()["AP50"]

    assert ap50(0, 5, 10) < ap50()  # seeds 0, 5, 10: no objects


def test_no_object_or_no_detection_is_zero():
    zeros = {"mAP": 0.0, "AP50": 0.0, "recall3d_25": 0.0}
    metric = DetectionMetric()
    update(metric, [0, 5])
    assert metric.compute() == zeros
    nothing = (torch.zeros(1, 0), torch.zeros(1, 0, dtype=torch.long))
    boxes = (torch.zeros(1, 0, 4), torch.zeros(1, 0, 6))
    metric = DetectionMetric()
    metric.update(torch.tensor([0]), *nothing, *boxes, [random_frame(3)[4]])
    assert metric.compute() == zeros
    metric = DetectionMetric()
    metric.update(torch.tensor([0]), *nothing, *boxes, [empty_target()])
    assert metric.compute() == zeros


def test_a_frame_that_comes_twice_counts_once():
    once, twice = DetectionMetric(), DetectionMetric()
    update(once, [3, 4, 7])
    update(twice, [3, 4])
    update(twice, [7, 3])
    assert twice.compute() == once.compute()


def recall_of(detections, objects, threshold=0.3):
    """3D recall of (score, class, box3d) detections for (class, box3d) objects."""
    target = boxes_target(
        [c for c, _ in objects],
        [[0.5, 0.5, 0.2, 0.2]] * len(objects),
        torch.tensor([box for _, box in objects]),
    )
    metric = DetectionMetric(score_threshold=threshold)
    metric.update(
        torch.tensor([0]),
        torch.tensor([[s for s, _, _ in detections]]),
        torch.tensor([[c for _, c, _ in detections]]),
        torch.zeros(1, len(detections), 4),
        torch.tensor([[box for _, _, box in detections]]),
        [target],
    )
    return metric.compute()["recall3d_25"]


def box_at(x, size=2.0):
    return [float(x), 0.0, 10.0, size, 2.0, 2.0]


def test_recall_3d_by_hand():
    cars = [(1, box_at(0)), (1, box_at(5))]
    assert recall_of([(0.9, 1, box_at(1)), (0.8, 1, box_at(5))], cars) == 1.0  # IoU 1/3 and 1
    assert recall_of([(0.9, 1, box_at(1.3)), (0.8, 1, box_at(5))], cars) == 0.5  # IoU 0.21
    assert recall_of([(0.9, 2, box_at(0)), (0.8, 1, box_at(5))], cars) == 0.5  # another class
    assert recall_of([(0.29, 1, box_at(0)), (0.8, 1, box_at(5))], cars) == 0.5  # not sure enough
    assert recall_of([(0.29, 1, box_at(0)), (0.8, 1, box_at(5))], cars, threshold=0.2) == 1.0
    assert recall_of([(0.9, 1, box_at(0)), (0.8, 1, box_at(0.1))], cars) == 0.5  # one to one


def test_recall_3d_lets_the_second_take_what_is_free():
    near = [(1, box_at(0)), (1, box_at(0.8))]
    assert recall_of([(0.9, 1, box_at(0.1)), (0.8, 1, box_at(0.1))], near) == 1.0


# ---------------------------------------------------------------------------- over ranks


def completion_of(frames):
    metric = SemanticSceneCompletion()
    for index in frames:
        metric.update(*(torch.from_numpy(grid) for grid in random_grids(index, frames=1)))
    return metric


def detection_of(frames):
    metric = DetectionMetric()
    for index in frames:
        update(metric, [index])
    return metric


def evaluator_of(frames):
    evaluator = SceneEvaluator((370, 1220), detects=True)
    for index in frames:
        grids = random_grids(index, frames=1)
        evaluator.completion.update(*(torch.from_numpy(grid) for grid in grids))
        for metric in (evaluator.detection, evaluator.recall):
            update(metric, [index])
    return evaluator


#: What the two ranks see: an odd number of frames, and a rank without any.
SHARES = (([3, 5, 9], [4, 7]), ([3, 4, 5, 7, 9], []), ([], [3, 4, 5, 7, 9]))
PADDED = ([3, 5, 9], [4, 7, 3])


def run_rank(rank, folder):
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo",
        init_method=f"file://{folder}/store",
        rank=rank,
        world_size=2,
        timeout=timedelta(seconds=60),  # a rank that waits for one that never comes fails
    )
    found = [detection_of(share[rank]).compute() for share in (*SHARES, PADDED)]
    found += [completion_of(share[rank]).compute() for share in SHARES]
    found += [evaluator_of(share[rank]).compute() for share in SHARES]
    torch.save(found, f"{folder}/rank{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.filterwarnings("ignore")
def test_two_ranks_give_the_scores_of_one(tmp_path):
    spawn(run_rank, (str(tmp_path),), nprocs=2)
    frames = [3, 4, 5, 7, 9]
    expected = [detection_of(frames).compute()] * 4 + [completion_of(frames).compute()] * 3
    expected += [evaluator_of(frames).compute()] * 3
    assert expected[-1]["objects_found"]
    for rank in range(2):
        assert torch.load(tmp_path / f"rank{rank}.pt") == expected


# ---------------------------------------------------------------------------- baseline


def test_baseline_predicts_the_most_frequent_class_of_each_position():
    votes = np.array(
        [[1, 1, 2], [0, 5, 5], [9, 4, 255], [255, 255, 255], [255, 255, 19], [0, 0, 7]],
        dtype=np.uint8,
    )
    baseline = PositionBaseline(grid_shape=(6, 1, 1))
    assert not baseline.predict().any()
    for frame in votes.T:
        baseline.update(frame.reshape(6, 1, 1))
    prediction = baseline.predict()
    assert prediction.dtype == np.uint8
    assert prediction.ravel().tolist() == [1, 5, 4, 0, 19, 0]
    assert baseline.num_frames == 3


def test_baseline_equals_a_count_of_everything():
    grids = random_grids(5, frames=7)[1]
    baseline = PositionBaseline(grid_shape=SMALL)
    for grid in grids:
        baseline.update(grid)
    counts = (grids[None] == np.arange(20).reshape(20, 1, 1, 1, 1)).sum(axis=1)
    np.testing.assert_array_equal(baseline.counts, counts)
    np.testing.assert_array_equal(baseline.predict(), counts.argmax(axis=0))
