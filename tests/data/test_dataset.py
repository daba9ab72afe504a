"""Items and batches: resized, augmented and matched consistently."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from occdetr.data.augment import Augmentation
from occdetr.data.cache import ObjectCache
from occdetr.data.dataset import NetworkInput, PictureDataset, SceneDataset, collate
from occdetr.data.early_matching import match_rois
from occdetr.data.frames import find_frames
from occdetr.data.images import load_picture
from occdetr.data.objects import ObjectSettings
from occdetr.data.semantickitti import read_labels
from occdetr.geometry.voxels import voxels_to_metres
from occdetr.structures import SceneBatch
from scene_factory import IMAGE_SIZE, write_dataset

MODEL_SIZE = (64, 208)
EVERY_PIXEL = ObjectSettings(ray_stride=1)
NETWORK = NetworkInput(MODEL_SIZE, (8, 16), 2.0)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dataset(tmp_path, "00", num_frames=5)
    return tmp_path


def dataset(root: Path, seed: int = 0, **augmentation) -> SceneDataset:
    labels = ObjectCache(EVERY_PIXEL, root / "c")
    chosen = Augmentation(**augmentation)
    return SceneDataset(find_frames(root, ["00"]), NETWORK, labels, chosen, seed)


def test_item(root: Path) -> None:
    item = dataset(root)[1]
    assert item.image.shape == (3, *MODEL_SIZE)
    camera = item.camera
    assert item.image.dtype == torch.uint8
    assert camera.projection.dtype == camera.lidar_to_camera.dtype == torch.float32
    assert camera.image_size == tuple(item.image.shape[1:])
    assert (item.frame_index, item.frame_id) == (1, "00/000005")
    assert item.labels is not None
    assert np.array_equal(item.labels.numpy(), read_labels(find_frames(root, ["00"])[1]))
    target = item.target
    assert target is not None
    assert len(target) == 2
    assert np.array_equal(target.roi_indices, match_rois(target.boxes_cxcywh.numpy(), NETWORK.rois))
    assert len(set(target.roi_indices.tolist())) == 2
    assert target.voxel_object.max() == 1


def test_items_without_labels_need_none(root: Path) -> None:
    for kind in ("label", "invalid"):
        for file in root.glob(f"sequences/00/voxels/*.{kind}"):
            file.unlink()
    frames = find_frames(root, ["00"], labels=False)
    item = SceneDataset(frames, NETWORK)[0]
    assert item.labels is None
    assert item.target is None


def test_items_without_object_classes_have_empty_targets(root: Path) -> None:
    nothing = ObjectCache(ObjectSettings(classes=()), root / "c")
    item = SceneDataset(find_frames(root, ["00"]), NETWORK, nothing)[0]
    assert item.labels is not None
    assert item.target is not None
    assert len(item.target) == 0
    assert item.target.voxels.shape == (0, 3)


def test_image_files_without_a_dataset_folder(root: Path, tmp_path: Path) -> None:
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


def test_flipped_items_are_consistent(root: Path) -> None:
    """Voxels projected by the item's camera are bounded by the item's boxes."""
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
    assert np.array_equal(target.roi_indices, match_rois(target.boxes_cxcywh.numpy(), NETWORK.rois))


def test_flips_have_their_probability_and_are_reproducible(root: Path) -> None:
    frames = dataset(root, flip=0.5)
    plain = dataset(root)[0].image
    flipped = [not torch.equal(frames[epoch, 0].image, plain) for epoch in range(40)]
    assert 10 <= sum(flipped) <= 30
    assert flipped == [
        not torch.equal(dataset(root, flip=0.5)[epoch, 0].image, plain) for epoch in range(40)
    ]
    other = dataset(root, flip=0.5, seed=1)
    assert flipped != [not torch.equal(other[epoch, 0].image, plain) for epoch in range(40)]


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
