"""Items, batches and loaders: resized, mirrored and matched consistently; every frame once."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from occdetr.data import cache, datamodule
from occdetr.data.augment import flip_calibration, flip_objects, jitter_colors
from occdetr.data.datamodule import SceneDataModule
from occdetr.data.dataset import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    PictureDataset,
    SceneDataset,
    collate,
    load_picture,
    make_item,
    resize_image,
)
from occdetr.data.frames import find_frames
from occdetr.data.objects import ObjectSettings, extract_objects
from occdetr.data.sampler import FrameSampler
from occdetr.data.semantickitti import read_labels
from occdetr.errors import InputError
from occdetr.files import write_image
from occdetr.geometry.rois import match_rois, preset_rois
from occdetr.geometry.voxels import voxels_to_metres
from occdetr.streets.datamodule import SyntheticDataModule
from occdetr.streets.writer import GENERATOR_VERSION
from occdetr.structures import SceneBatch
from scene_factory import (
    CAMERA,
    IMAGE_SIZE,
    REAL_ROOT,
    REAL_SEQUENCES,
    project_brute_force,
    put_box,
    street,
    write_dataset,
)

MODEL_SIZE = (64, 208)
EVERY_PIXEL = ObjectSettings(ray_stride=1)
ROIS = preset_rois(MODEL_SIZE, (8, 16), 2.0)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dataset(tmp_path, "00", num_frames=5)
    write_dataset(tmp_path, "08", num_frames=3)
    return tmp_path


def module(root: Path, **keywords) -> SceneDataModule:
    settings = {
        "train_sequences": ["00"],
        "test_sequences": ["08"],
        "strides": [8, 16],
        "objects": EVERY_PIXEL,
    }
    return SceneDataModule(root, list(MODEL_SIZE), **(settings | keywords))


def dataset(root: Path, **keywords) -> SceneDataset:
    frames = find_frames(root, ["00"])
    return SceneDataset(frames, MODEL_SIZE, EVERY_PIXEL, ROIS, cache_dir=root / "c", **keywords)


# items


def test_item(root: Path) -> None:
    item = dataset(root)[1]
    assert item.image.shape == (3, *MODEL_SIZE)
    camera = item.camera
    assert item.image.dtype == camera.projection.dtype == torch.float32
    assert camera.lidar_to_camera.dtype == torch.float32
    assert camera.image_size == tuple(item.image.shape[1:])
    assert (item.frame_index, item.frame_id) == (1, "00/000005")
    assert item.labels is not None
    assert np.array_equal(item.labels.numpy(), read_labels(find_frames(root, ["00"])[1]))
    target = item.target
    assert target is not None
    assert len(target) == 2
    assert np.array_equal(target.roi_indices, match_rois(target.boxes_cxcywh.numpy(), ROIS))
    assert len(set(target.roi_indices.tolist())) == 2
    assert target.voxel_object.max() == 1


def test_items_without_labels_need_none(root: Path) -> None:
    for kind in ("label", "invalid"):
        for file in root.glob(f"sequences/00/voxels/*.{kind}"):
            file.unlink()
    frames = find_frames(root, ["00"], labels=False)
    item = SceneDataset(frames, MODEL_SIZE, EVERY_PIXEL, ROIS, with_labels=False)[0]
    assert item.labels is None
    assert item.target is None


def test_items_without_object_classes_have_empty_targets(root: Path) -> None:
    items = [
        SceneDataset(find_frames(root, ["00"]), MODEL_SIZE, objects, ROIS, cache_dir=root / "c")[0]
        for objects in (None, ObjectSettings(classes=()))
    ]
    for item in items:
        assert item.labels is not None
        assert item.target is not None
        assert len(item.target) == 0
        assert item.target.voxels.shape == (0, 3)


def test_resized_pictures_keep_their_intrinsics() -> None:
    """A bright blob at the projection of a point is found at its projection after resizing."""
    point = np.array([[12.0, -2.0, 0.5]])
    pixel = project_brute_force(point, CAMERA)[0][0]
    rows, columns = np.mgrid[0 : IMAGE_SIZE[0], 0 : IMAGE_SIZE[1]]
    distance = (columns - pixel[0]) ** 2 + (rows - pixel[1]) ** 2
    blob = (250 * np.exp(-distance / 50)).astype(np.uint8)
    image = np.repeat(blob[..., None], 3, axis=2)
    for size in (MODEL_SIZE, (60, 100), (240, 900)):
        resized, camera = resize_image(image, CAMERA, size)
        expected = project_brute_force(point, camera)[0][0]
        weight = resized[..., 0].astype(float)
        rows, columns = np.mgrid[0 : size[0], 0 : size[1]]
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        np.testing.assert_allclose(found, expected, atol=0.05)


def test_pictures_are_normalised_as_imagenet() -> None:
    image = np.zeros((*MODEL_SIZE, 3), dtype=np.uint8)
    image[..., 0], image[..., 2] = 255, 51  # red, blue
    item = make_item(image, CAMERA, 0, "")
    expected = (np.array([1.0, 0.0, 0.2]) - IMAGENET_MEAN) / IMAGENET_STD
    np.testing.assert_allclose(item.image[:, 3, 5], expected, atol=1e-5)
    np.testing.assert_allclose(item.camera.projection, CAMERA.projection, rtol=1e-6)


@pytest.mark.parametrize("size", [(60, 200), (240, 800), (120, 150)])
def test_a_picture_of_another_size_is_refused(root: Path, size: tuple[int, int]) -> None:
    file = root / "sequences" / "00" / "image_2" / "000005.png"
    write_image(file, np.zeros((*size, 3), dtype=np.uint8))
    with pytest.raises(InputError, match=r"000005\.png: wrong image size.*calib\.txt") as error:
        dataset(root)[1]
    assert "\n" not in str(error.value)


def test_pictures_outside_a_dataset(root: Path, tmp_path: Path) -> None:
    photo = tmp_path / "photos" / "street.png"
    photo.parent.mkdir()
    image = np.random.default_rng(0).integers(0, 255, (*IMAGE_SIZE, 3), dtype=np.uint8)
    cv2.imwrite(str(photo), image)
    calibration = root / "sequences" / "00" / "calib.txt"
    batch = collate([PictureDataset([photo], calibration, MODEL_SIZE)[0]])
    assert batch.frame_ids == ["street"]
    assert batch.labels is None
    assert batch.targets is None
    expected, camera = load_picture(photo, calibration, MODEL_SIZE)
    assert expected.shape == (*MODEL_SIZE, 3)
    np.testing.assert_allclose(batch.camera.projection[0], camera.projection, rtol=1e-5)


# augmentation


def test_a_flip_mirrors_every_projection() -> None:
    mirrored = flip_calibration(CAMERA, IMAGE_SIZE[1])
    points = np.random.default_rng(1).uniform([1, -20, -2], [50, 20, 4], (500, 3))
    pixels, depth = project_brute_force(points, CAMERA)
    flipped, flipped_depth = project_brute_force(points * [1, -1, 1], mirrored)
    np.testing.assert_allclose(flipped[:, 0], IMAGE_SIZE[1] - 1 - pixels[:, 0], atol=1e-8)
    np.testing.assert_allclose(flipped[:, 1], pixels[:, 1], atol=1e-8)
    np.testing.assert_allclose(flipped_depth, depth, atol=1e-10)
    assert mirrored.projection[0, 0] > 0
    assert np.linalg.det(mirrored.lidar_to_camera[:3, :3]) == pytest.approx(1, abs=1e-3)


def test_flipped_objects_are_the_objects_of_the_flipped_world() -> None:
    """Extracting from mirrored labels with the mirrored camera gives the mirrored objects."""
    labels = street()
    put_box(labels, "truck", (20.0, -6.0, 0.0), (6.0, 2.4, 3.0))
    flipped = flip_objects(extract_objects(labels, CAMERA, IMAGE_SIZE, EVERY_PIXEL))
    mirrored = np.ascontiguousarray(labels[:, ::-1])
    camera = flip_calibration(CAMERA, IMAGE_SIZE[1])
    expected = extract_objects(mirrored, camera, IMAGE_SIZE, EVERY_PIXEL)
    assert len(flipped) == len(expected) == 3
    order, other = np.argsort(flipped.classes), np.argsort(expected.classes)
    for name in ("classes", "boxes_cxcywh", "boxes3d_camera", "boxes3d_grid"):
        ours, theirs = getattr(flipped, name)[order], getattr(expected, name)[other]
        np.testing.assert_allclose(ours, theirs, atol=1e-4, err_msg=name)
    np.testing.assert_allclose(
        flipped.visible_fraction[order], expected.visible_fraction[other], atol=0.03
    )
    voxel_classes = flipped.classes[flipped.voxel_object]
    assert (mirrored[tuple(flipped.voxels.T)] == voxel_classes).all()


def test_a_flipped_item_stays_true_to_itself(root: Path) -> None:
    """Voxels, projected by the item's own camera, land on the mirrored pixels, and in the boxes."""
    plain, flipped = dataset(root)[0], dataset(root, flip=1.0)[0]
    assert torch.equal(flipped.image, plain.image.flip(-1))
    assert flipped.labels is not None
    assert plain.labels is not None
    assert torch.equal(flipped.labels, plain.labels.flip(1))
    target = flipped.target
    assert target is not None
    for index, name in enumerate(target.classes):
        voxels = target.voxels[target.voxel_object == index].numpy()
        assert (flipped.labels[tuple(voxels.T)] == name).all()
        corners = np.concatenate([voxels + c for c in itertools.product((0, 1), repeat=3)])
        homogeneous = np.c_[voxels_to_metres(corners), np.ones(len(corners))]
        matrix = flipped.camera.projection @ flipped.camera.lidar_to_camera
        rows = homogeneous @ matrix.double().numpy().T
        points = (rows[:, :2] / rows[:, 2:] + 0.5) / [MODEL_SIZE[1], MODEL_SIZE[0]]
        center, size = target.boxes_cxcywh[index, :2], target.boxes_cxcywh[index, 2:]
        np.testing.assert_allclose((points.min(0) + points.max(0)) / 2, center, atol=1e-4)
        np.testing.assert_allclose(points.max(0) - points.min(0), size, atol=1e-4)
    assert np.array_equal(target.roi_indices, match_rois(target.boxes_cxcywh.numpy(), ROIS))


def test_flips_happen_with_their_probability_and_repeat(root: Path) -> None:
    frames = dataset(root, flip=0.5)
    plain = dataset(root)[0].image
    flipped = [not torch.equal(frames[epoch, 0].image, plain) for epoch in range(40)]
    assert 10 <= sum(flipped) <= 30
    assert flipped == [
        not torch.equal(dataset(root, flip=0.5)[epoch, 0].image, plain) for epoch in range(40)
    ]
    other = dataset(root, flip=0.5, seed=1)
    assert flipped != [not torch.equal(other[epoch, 0].image, plain) for epoch in range(40)]


def test_jitter_changes_colours_only_so_far() -> None:
    image = np.full((4, 5, 3), (120, 100, 80), dtype=np.uint8)
    means = [jitter_colors(image, 0.2, np.random.default_rng(seed)).mean() for seed in range(50)]
    assert 79 < min(means) < 95
    assert 105 < max(means) < 121
    unchanged = jitter_colors(image, 0.0, np.random.default_rng(0))
    assert np.abs(unchanged.astype(int) - image).max() <= 1


# batches


def test_collate_and_move(root: Path) -> None:
    items = [dataset(root)[index] for index in (2, 0)]
    batch = collate(items)
    assert isinstance(batch, SceneBatch)
    assert len(batch) == 2
    assert batch.frame_indices.tolist() == [2, 0]
    assert batch.frame_ids == ["00/000010", "00/000000"]
    assert batch.labels is not None
    assert batch.labels.shape == (2, 256, 256, 32)
    assert batch.targets is not None
    assert [len(target) for target in batch.targets] == [2, 2]
    meta = batch.to("meta")
    assert meta.images.is_meta
    assert meta.targets is not None
    assert meta.targets[1].roi_indices.is_meta


# samplers


@pytest.mark.parametrize("world_size", [1, 2, 3, 7])
def test_every_frame_is_evaluated_once_over_all_ranks(world_size: int) -> None:
    frames = range(5)
    parts = [list(FrameSampler(frames, False, 0, rank, world_size)) for rank in range(world_size)]
    assert sorted(itertools.chain(*parts)) == list(frames)
    for rank, part in enumerate(parts):
        assert len(FrameSampler(frames, False, 0, rank, world_size)) == len(part)


@pytest.mark.parametrize("world_size", [1, 2, 3])
def test_training_ranks_share_each_epoch_equally(world_size: int) -> None:
    frames = range(10)
    orders = []
    for epoch in range(2):
        samplers = [FrameSampler(frames, True, 3, rank, world_size) for rank in range(world_size)]
        for sampler in samplers:
            sampler.set_epoch(epoch)
        parts = [list(sampler) for sampler in samplers]
        assert {len(part) for part in parts} == {-(-10 // world_size)}
        drawn = list(itertools.chain(*parts))
        assert {index for _, index in drawn} == set(frames)
        assert {of for of, _ in drawn} == {epoch}
        orders.append([index for _, index in drawn])
    assert orders[0] != orders[1]


# modules


def test_loaders(root: Path) -> None:
    scenes = module(root, batch_size=2)
    scenes.setup("fit")
    assert scenes.summary("train").startswith("train: 5 frames (sequence 00, stride 5)")
    train = list(scenes.train_dataloader())
    assert sorted(len(batch) for batch in train) == [1, 2, 2]  # nothing is dropped
    assert sorted(torch.cat([batch.frame_indices for batch in train]).tolist()) == [*range(5)]
    val = list(scenes.val_dataloader())
    assert [name for batch in val for name in batch.frame_ids] == [
        "08/000000",
        "08/000005",
        "08/000010",
    ]
    assert all(batch.targets is not None and batch.labels is not None for batch in val)
    scenes.setup("predict")
    predict = next(iter(scenes.predict_dataloader()))
    assert predict.labels is None
    assert predict.targets is None
    assert (root / cache.CACHE_FOLDER).is_dir()


def test_workers_change_nothing(root: Path) -> None:
    batches = []
    for num_workers in (0, 2):
        scenes = module(root, num_workers=num_workers, flip=0.5, photometric=0.4)
        loader = scenes.train_dataloader()
        loader.sampler.set_epoch(3)  # pyright: ignore[reportAttributeAccessIssue]
        batches.append(list(loader))
    for alone, worked in zip(*batches, strict=True):
        assert alone.frame_ids == worked.frame_ids
        assert torch.equal(alone.images, worked.images)
        assert torch.equal(alone.labels, worked.labels)


def test_only_training_is_augmented(root: Path) -> None:
    scenes = module(root, flip=1.0, train_sequences=["00"], val_sequences=["00"])
    train = {batch.frame_ids[0]: batch for batch in scenes.train_dataloader()}
    for batch in scenes.val_dataloader():
        assert torch.equal(batch.images.flip(-1), train[batch.frame_ids[0]].images)
        assert not torch.equal(batch.images, train[batch.frame_ids[0]].images)


def test_evaluated_split(root: Path) -> None:
    for split, count in (("train", 5), ("val", 3)):
        scenes = module(root, eval_split=split)
        scenes.setup("test")
        assert len(list(scenes.test_dataloader())) == count
    with pytest.raises(InputError, match="eval_split=test"):
        module(root, eval_split="test")


@pytest.mark.parametrize("stage", ["fit", "validate", "test"])
def test_every_process_needs_a_frame_to_evaluate(
    root: Path, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There are 5 frames to train on, which are shared as needed, and 3 to evaluate."""
    monkeypatch.setattr(datamodule, "_place", lambda trainer: (0, 3))
    module(root).setup(stage)
    monkeypatch.setattr(datamodule, "_place", lambda trainer: (0, 4))
    with pytest.raises(InputError, match=r"trainer\.devices: 4 processes for val: 3 frames"):
        module(root).setup(stage)


def test_pictures_can_be_exchanged(root: Path) -> None:
    """Labels stay, and no frame keeps its picture; with one frame alone there is none to give."""
    own, exchanged = (
        list(module(root, exchange_images=value).test_dataloader()) for value in (False, True)
    )
    pictures = {batch.frame_ids[0]: batch.images for batch in own}
    for before, after in zip(own, exchanged, strict=True):
        assert before.frame_ids == after.frame_ids
        assert torch.equal(before.labels, after.labels)
        assert not torch.equal(before.images, after.images)
        assert any(torch.equal(after.images, picture) for picture in pictures.values())
    alone = module(root, exchange_images=True, val_sequences=["00"], stride=1000)
    with pytest.raises(InputError, match="one frame alone"):
        alone.test_dataloader()


@pytest.mark.parametrize(
    ("keywords", "word"),
    [
        ({"batch_size": 0}, "batch_size=0"),
        ({"num_workers": -1}, "num_workers=-1"),
        ({"flip": 1.5}, "flip=1.5"),
        ({"photometric": 1.0}, "photometric=1.0"),
        ({"stride": 0}, "stride=0"),
    ],
)
def test_settings_that_mean_nothing_are_refused(root: Path, keywords: dict, word: str) -> None:
    with pytest.raises(InputError, match=f"data.{word}"):
        module(root, **keywords)


def test_a_missing_sequence_stops_at_setup(root: Path) -> None:
    with pytest.raises(InputError, match="sequence 03 is missing"):
        module(root, train_sequences=["03"]).setup("fit")


def test_objects_can_be_prepared_before(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = module(root)
    done = scenes.prepare_objects(progress=False)
    assert (done.built, done.reused, done.objects) == (8, 0, 16)
    monkeypatch.setattr(cache, "extract_objects", lambda *args: pytest.fail("built again"))
    assert len(list(scenes.train_dataloader())) == 5


def test_synthetic_streets_are_written_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    streets = SyntheticDataModule(
        num_train=2,
        num_val=1,
        root=tmp_path / "streets",
        seed=5,
        street_image_size=[96, 320],
        write_workers=1,
        image_size=list(MODEL_SIZE),
        batch_size=2,
    )
    streets.prepare_data()
    files = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.label")}
    assert len(files) == 3
    streets.setup("fit")
    batch = next(iter(streets.train_dataloader()))
    assert len(batch) == 2
    assert batch.images.shape == (2, 3, *MODEL_SIZE)
    assert len(list(streets.val_dataloader())) == 1
    streets.prepare_data()
    assert files == {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.label")}
    assert f"streets-v{GENERATOR_VERSION}" in str(streets.cache_dir)
    assert f"generator version {GENERATOR_VERSION}, seed 5" in streets.summary("train")


# real frames


@pytest.mark.skipif(not REAL_ROOT.is_dir(), reason="no real frames here")
def test_real_frames_load(tmp_path: Path) -> None:
    scenes = SceneDataModule(
        REAL_ROOT, [128, 416], train_sequences=REAL_SEQUENCES, cache_dir=tmp_path, batch_size=4
    )
    count, objects = 0, 0
    for batch in scenes.train_dataloader():
        count += len(batch)
        assert torch.isfinite(batch.images).all()
        assert batch.targets is not None
        objects += sum(len(target) for target in batch.targets)
        assert batch.labels is not None
        assert set(batch.labels.unique().tolist()) <= {*range(20), 255}
    assert count == 20
    assert objects > 150
    assert os.listdir(tmp_path)
